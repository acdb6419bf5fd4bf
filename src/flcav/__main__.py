"""`python -m flcav`: the command line."""

from flcav.cli.main import run

if __name__ == "__main__":
    run()
