"""`python -m simtest`: the command line."""

from simtest.cli.main import main

main()
