"""The methods that can be run by name, one file each, and their presets."""
