"""Props, the objects that may change: boxes, chairs, vehicles, rocks, muck piles, meshes from files; see HOWTO.md."""
