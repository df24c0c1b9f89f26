"""The commands of `tunnelcd`, a file for each group."""
