"""Names of the releases that come with the package; a shell that completes them imports nothing else."""

from importlib import resources


def release_names() -> list[str]:
    """Return the names of the releases that come with the package."""
    folder = resources.files("eval") / "release"
    return sorted(file.name.removesuffix(".yaml") for file in folder.iterdir() if file.name.endswith(".yaml"))
