"""What made a result: code, settings, machine and command."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from cdpipe.core.plugins import extra_version
from cdpipe.core.threads import THREAD_VARIABLES

TOOL = "tunnelcd"
FORMAT_VERSION = 1
# Rows depend on these except `distributed`, which all workers of a cluster share; runs that differ are not mixed.
_PACKAGES = (
    "tunnelcd", "numpy", "scipy", "pandas", "torch", "mujoco", "embreex", "trimesh", "small_gicp", "kiss-matcher",
    "py4dgeo", "dufomap", "pyoctomap", "kiss-icp", "warp-lang", "scikit-image", "pydantic", "matplotlib", "distributed",
)  # fmt: skip
# Rows of worlds that are recordings depend on these too: they read the recordings, or estimate their poses.
_OF_RECORDINGS = ("genz-icp", "ouster-sdk", "pypcd4", "laspy", "lazrs", "pye57", "rosbags")
# No row depends on these: they show, convert to other formats and store; dask is covered by `distributed`.
IDLE = ("viser", "rerun-sdk", "mcap", "pyarrow", "mlcroissant", "dask")


def digest(value: Any) -> str:
    """Return a short digest of anything JSON can hold; the order of keys does not matter."""
    return _digest_text(canonical_json(value))


def canonical_json(value: Any) -> str:
    """Return the text that `digest` is of."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"))


def digest_parts(parts: Mapping[str, str]) -> str:
    """Return the digest of a mapping whose values are canonical JSON already, equal to that of the mapping itself."""
    return _digest_text("{" + ",".join(f"{json.dumps(name)}:{parts[name]}" for name in sorted(parts)) + "}")


def digest_file(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _digest_text(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def machine() -> dict[str, Any]:
    """Return what the machine and its thread settings are."""
    return {
        "platform": f"{platform.system()} {platform.machine()}",
        "cpu": _cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gb": _memory_gb(),
        "threads": {name: os.environ.get(name, "unset") for name in THREAD_VARIABLES},
    }


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that results depend on; "absent" where not installed."""
    return {"python": platform.python_version(), **_versions_of((*_PACKAGES, *_OF_RECORDINGS))}


def _versions_of(packages: Sequence[str]) -> dict[str, str]:
    return {name: extra_version(name) for name in packages}


def describe_run(
    plan: Mapping[str, Any],
    configs: Mapping[str, Any],
    checkpoints: Mapping[str, str],
    command: Sequence[str],
    commit: str | None,
    started: str,
) -> dict[str, Any]:
    """Return the content of provenance.json.

    Args:
        plan: The plan as run, dumped.
        configs: Effective settings of every "<scenario> <variant>", dumped.
        checkpoints: Digest of the weights of every descriptor used.
        command: The command line.
        commit: The code that runs (`git_commit`).
        started: When the run began (`now`).
    """
    return {
        "tool": TOOL,
        "format_version": FORMAT_VERSION,
        "started": started,
        "finished": None,
        "command": shlex.join(command),
        "plan": dict(plan),
        "plan_digest": digest(plan),
        "seeds": list(plan["seeds"]),
        "config_digests": {name: digest(config) for name, config in configs.items()},
        "checkpoints": dict(checkpoints),
        "versions": {"python": platform.python_version(), **_versions_of(_PACKAGES)},
        "extras": _versions_of((*_OF_RECORDINGS, *IDLE)),
        "git_commit": commit,
        "machine": machine(),
    }


def now() -> str:
    """Return the present time, UTC, ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def git_commit() -> str | None:
    """Commit of the source tree this package runs from, with "+" where files differ from it; None outside git."""
    root = Path(__file__).resolve().parents[2]
    if not (root / ".git").exists():
        return None
    try:
        commit, changed = (
            subprocess.run(["git", *words], cwd=root, capture_output=True, text=True, check=True, timeout=10).stdout
            for words in (("rev-parse", "HEAD"), ("status", "--porcelain"))
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return commit.strip() + ("+" if changed.strip() else "")


def _cpu_model() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def _memory_gb() -> float | None:
    if sys.platform == "win32":
        return None
    return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
