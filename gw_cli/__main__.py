"""`python -m gw_cli`."""

from gw_cli.app import main

main()
