"""What single settings do, on the page: of the world, of a method, and grids of two."""
