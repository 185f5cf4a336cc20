"""Bayesian inference for any log density: fits, draws, diagnostics and summaries."""
