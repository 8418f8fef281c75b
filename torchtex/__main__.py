"""`python -m torchtex`, the command line."""

from torchtex.cli import main

if __name__ == "__main__":
    main()
