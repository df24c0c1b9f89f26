"""What an Ouster sensor is: its metadata, its beam table and the ray of every pixel."""
