"""Run the program as ``python -m tactile_bayes``."""

from tactile_bayes.cli import main

if __name__ == "__main__":
    main()
