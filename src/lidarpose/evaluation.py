"""Evaluation of networks on datasets, as done by `lidarpose evaluate` and `lidarpose table`.

    from lidarpose import evaluation
    result = evaluation.evaluate("small", "bench")            # or a Predictor, and a folder from prepare or synth
    result.line("mpjpe").value, result.line("mpjpe", "joints", "wrists").low
    evaluation.write(evaluation.run("small", ["bench"]), "evaluation/small")
    print(evaluation.table(["evaluation/small"]))

docs/evaluate.md describes the protocols and the files.
"""

from lidarpose.eval.dataset import BENCH
from lidarpose.eval.predictions import Predictions, read_poses
from lidarpose.eval.protocols import PROTOCOLS
from lidarpose.eval.robustness import Stability
from lidarpose.eval.run import Run, check_folder, evaluate, new_folder, run, write
from lidarpose.eval.scores import MetricRow, Result, Scores, Setting, read_scores, scores_path
from lidarpose.eval.table import published, table

# aliases with the names used until 0.2
Judged, Line = Predictions, MetricRow

__all__ = [
    "BENCH", "Judged", "Line", "MetricRow", "PROTOCOLS", "Predictions", "Result", "Run", "Scores", "Setting",
    "Stability", "check_folder", "evaluate", "new_folder", "published", "read_poses", "read_scores", "run",
    "scores_path", "table", "write",
]  # fmt: skip
