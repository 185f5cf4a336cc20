"""Bayesian inference for any log density: fits, draws, their diagnostics and summaries. Knows no map."""
