from .answer_check import check_answer
from .scoring import METRICS_VERSION, CaseScore, score_answer, score_pair

__all__ = [
    "METRICS_VERSION",
    "CaseScore",
    "check_answer",
    "score_answer",
    "score_pair",
]
