"""The public Python API: `import tactile_bayes as tb` offers it, each name loaded on first use."""
