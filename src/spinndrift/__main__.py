"""`python -m spinndrift`: the console command."""

from .sims.cli import main

if __name__ == "__main__":
    main()
