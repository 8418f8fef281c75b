"""`python -m torchtex.cli`."""

from torchtex.cli import main

if __name__ == "__main__":
    main()
