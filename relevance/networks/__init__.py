"""Trained networks as files, and run without torch: what guides a planner.

A checkpoint holds its weights once, and graphs for ONNX Runtime that have none: they are given
the weights when they are loaded, so that the two cannot drift apart.
"""

from relevance.networks.champions import (
    CHAMPION,
    Event,
    Learned,
    Record,
    age,
    crown,
    find_checkpoint,
    meant,
    read_record,
    refuse_remote,
    roll_back,
    settle,
)
from relevance.networks.files import (
    CHECKPOINT_VERSION,
    Checkpoint,
    CheckpointError,
    frame,
    named,
    read_checkpoint,
    shipped,
    unframe,
    write_checkpoint,
)
from relevance.networks.graphs import GRAPHS_VERSION, WEIGHTS, GraphNetwork, Network, label
from relevance.networks.poses import ANGLES, DECIMETRE, GEOMETRY, true_geometry

__all__ = [
    "ANGLES",
    "CHAMPION",
    "CHECKPOINT_VERSION",
    "DECIMETRE",
    "GEOMETRY",
    "GRAPHS_VERSION",
    "WEIGHTS",
    "Checkpoint",
    "CheckpointError",
    "Event",
    "GraphNetwork",
    "Learned",
    "Network",
    "Record",
    "age",
    "crown",
    "find_checkpoint",
    "frame",
    "label",
    "meant",
    "named",
    "read_checkpoint",
    "read_record",
    "refuse_remote",
    "roll_back",
    "settle",
    "shipped",
    "true_geometry",
    "unframe",
    "write_checkpoint",
]
