"""Errors and costs of a run, from the files of its result folder alone.

Owns the "camera" and "objects" blocks of metrics.json and the table made of them. Nothing here
runs beside the estimator, and the estimator imports nothing from here.
"""

from pipelines.evaluation.camera import evaluate_camera
from pipelines.evaluation.folder import evaluate_result
from pipelines.evaluation.objects import evaluate_objects
from pipelines.evaluation.table import metrics_text

__all__ = ["evaluate_camera", "evaluate_objects", "evaluate_result", "metrics_text"]
