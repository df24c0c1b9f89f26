"""The errors a user can cause. The command line prints each as one line and exits with code 2."""

from __future__ import annotations

from collections.abc import Mapping


class TunnelcdError(Exception):
    """Base of every error whose cause is the input; its text names the thing, the expectation and the way out."""


class InputError(TunnelcdError):
    """A file, folder, array or setting that cannot be used as given."""


class ScenarioError(InputError):
    """A scenario that cannot be built: mistakes in its file, or a world that contradicts itself."""


class MergeFailedError(TunnelcdError):
    """The two sessions could not be put into one frame with enough evidence.

    Attributes:
        evidence: What was measured, by name; values that were never reached are absent.
        seconds: How long it took to find that out, `t_index_s` and `t_merge_s`; empty where that was not measured.
    """

    def __init__(self, message: str, evidence: Mapping[str, float], seconds: Mapping[str, float] | None = None) -> None:
        super().__init__(message)
        self.evidence = dict(evidence)
        self.seconds = dict(seconds or {})
