"""What Python sees of the program: `import tactile_bayes as tb` offers it all, each name loaded when first used."""
