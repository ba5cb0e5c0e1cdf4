"""python -m evetac_cli."""

from evetac_cli.cli.main import main

if __name__ == "__main__":
    main()
