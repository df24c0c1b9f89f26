from .extract import FIGURES, extract_changes, hull_volume_m3, make_report
from .objects import PointGroup, assemble_objects
from .point_comparison import inlier_mask, is_within, label_clusters
from .shape import upright_box

__all__ = [
    "FIGURES",
    "PointGroup",
    "assemble_objects",
    "extract_changes",
    "hull_volume_m3",
    "inlier_mask",
    "is_within",
    "label_clusters",
    "make_report",
    "upright_box",
]
