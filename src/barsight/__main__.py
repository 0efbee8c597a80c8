"""`python -m barsight` is the command `barsight`."""

from barsight.cli.main import main

main()
