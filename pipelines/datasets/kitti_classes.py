"""KITTI's types of objects by the COCO names that a detector would give them.

Owns this one table.
"""

from __future__ import annotations

from pipelines.object_types import UNNAMED_CLASS

CLASSES = {
    "Car": "car",
    "Van": "car",
    "Truck": "truck",
    "Pedestrian": "person",
    "Person": "person",
    "Person_sitting": "person",
    "Cyclist": "bicycle",  # the box holds rider and bicycle
    "Tram": "train",
    "Misc": UNNAMED_CLASS,
}


def class_of_kitti(kind: str) -> str:
    """COCO's name of a KITTI type; a type that is not in the table keeps its own in lower case."""
    return CLASSES.get(kind, kind.lower())
