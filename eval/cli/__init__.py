"""The command line `tunnelcd`."""
