"""Run the command `barsight` by `python -m barsight`."""

from barsight.cli.main import main

main()
