"""Errors that a user can cause. The command line prints each as one line and exits with code 2."""

from __future__ import annotations

from collections.abc import Mapping

from cdpipe.core.names import visible


class _ShownError(Exception):
    """Text that may hold names of users and files: all that is not shown as it is but ends of lines is escaped."""

    def __str__(self) -> str:
        return "\n".join(map(visible, super().__str__().split("\n")))


class TunnelcdError(_ShownError):
    """Base of every error caused by the input; its text says what is wrong, where, what is expected, and a remedy."""


class InputWarning(_ShownError, UserWarning):  # noqa: N818 - it is a warning
    """Input that is used, though not as it is; the text says what was left out."""


class InputError(TunnelcdError):
    """A file, folder, array or setting that cannot be used as given."""


class ScenarioError(InputError):
    """A scenario that cannot be built: its file has mistakes, or its world is inconsistent."""


class MergeFailedError(TunnelcdError):
    """The evidence does not suffice to merge the two sessions.

    Attributes:
        evidence: Measured values by name; values that were not measured are absent.
        seconds: `t_index_s` and `t_merge_s` until the refusal; empty if not measured.
    """

    def __init__(self, message: str, evidence: Mapping[str, float], seconds: Mapping[str, float] | None = None) -> None:
        super().__init__(message)
        self.evidence = dict(evidence)
        self.seconds = dict(seconds or {})
