from .answer_check import check_answer
from .scoring import METRICS_VERSION, CaseScore, score, score_answer, score_stored

__all__ = [
    "METRICS_VERSION",
    "CaseScore",
    "check_answer",
    "score",
    "score_answer",
    "score_stored",
]
