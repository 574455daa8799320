"""``python -m contactgraph``: the command line where its program is not on the path."""

from contactgraph.cli.main import main

if __name__ == "__main__":
    main()
