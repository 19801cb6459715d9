"""How fast a body trains and looks, on made-up pictures and with the loss that trains it.

Needs no dataset and none of the libraries of planner and simulator.

Shape suffixes: B scenes, N objects, G goals, H and W height and width in pixels, h and w the
same at stride 4.
"""

from __future__ import annotations

import ctypes
import gc
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from relevance.models import GEOMETRY, PATCH, STRIDE, Body, RelevanceModel
from relevance.scene import PREDICATES, Camera
from relevance.training.checkpoints import pick_device
from relevance.training.examples import Batch
from relevance.training.losses import batch_loss
from relevance.training.settings import TrainConfig
from relevance.training.trainer import use_bfloat16

_PREDICATE = PREDICATES["on-the-left"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Speed:
    """What a body takes. Seconds are the processor's on a CPU (one thread), wall elsewhere."""

    parameters: int
    scenes: float
    """Scenes a second in training, each with all its goals: forward, backward and step."""
    queries: float
    """Queries a second of the same: what can be shared between them is."""
    queries_alone: float
    """Queries a second in training where each has an encoding of its own, as in the paper."""
    look: float
    """Seconds that one goal of one scene takes."""
    memory: int | None
    """Most bytes that training needed at once, beyond what the process had before; None where
    nobody counts them."""
    device: str
    bfloat16: bool
    """Whether matrices were multiplied in bfloat16."""


def measure_speed(
    config: TrainConfig,
    *,
    scenes: int = 4,
    goals: int = 4,
    objects: int = 10,
    queries: int = 50,
    seconds: float = 2.0,
) -> Speed:
    """Time a body: batches of scenes with some goals and objects each, then of single queries.

    Each of the three measurements goes on for some seconds, and for one step at least.
    """
    device = pick_device(config.device)
    bfloat16 = use_bfloat16(config.bfloat16, device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        before = _start_counting(device)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            model = RelevanceModel(config.model, [_PREDICATE.name]).to(device)
            camera = config.model.camera
            together = made_up_batch(camera, scenes=scenes, goals=goals, objects=objects)
            alone = _one_query_each(camera, model.body, queries, objects)
        optimizer = torch.optim.AdamW(model.parameters(), lr=config.learning_rate)

        def train(batch: Batch) -> None:
            model.train()
            with torch.autocast(device.type, torch.bfloat16, enabled=bfloat16):
                loss = batch_loss(model, batch.to(device), config)["loss"]
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            if config.clip:
                torch.nn.utils.clip_grad_norm_(model.parameters(), config.clip)
            optimizer.step()

        step = _seconds(lambda: train(together), device, seconds)
        memory = _count(device, before)
        step_alone = _seconds(lambda: train(alone), device, seconds)
        one = made_up_batch(camera, scenes=1, goals=1, objects=objects)

        @torch.inference_mode()
        def look() -> None:
            model.eval()
            encoding = model.encode(one.image, one.views, one.present, one.geometry)
            model.decode(encoding, _PREDICATE, one.turns[0][1]).cpu()

        seen = _seconds(look, device, seconds)
    finally:
        torch.set_num_threads(threads)
    return Speed(
        parameters=sum(weight.numel() for weight in model.parameters()),
        scenes=scenes / step,
        queries=int(together.turns[0][3].sum()) / step,
        queries_alone=queries / step_alone,
        look=seen,
        memory=memory,
        device=torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        bfloat16=bfloat16,
    )


def made_up_batch(camera: Camera, *, scenes: int, goals: int, objects: int, seed: int = 0) -> Batch:
    """Noise in the shape of a batch: every object is asked about in every goal."""
    rng = torch.Generator().manual_seed(seed)

    def noise(*shape: int, below: int = 256) -> torch.Tensor:
        return torch.randint(below, shape, dtype=torch.uint8, generator=rng)

    pairs = torch.stack([torch.randperm(objects, generator=rng)[:2] for _ in range(scenes * goals)])
    asked = (scenes, goals, objects)
    return Batch(
        image=noise(scenes, 3, camera.height, camera.width),
        views=noise(scenes, objects, 3, PATCH, PATCH),
        present=torch.ones(scenes, objects, dtype=torch.bool),
        cells=noise(scenes, camera.height // STRIDE, camera.width // STRIDE, below=objects + 1),
        names=tuple(f"made-up-{i}" for i in range(scenes)),
        geometry=torch.rand(scenes, objects, GEOMETRY, generator=rng),
        turns=(
            (
                _PREDICATE,
                pairs.view(scenes, goals, 2),
                torch.rand(asked, generator=rng) < 0.25,
                torch.ones(asked, dtype=torch.bool),
            ),
        ),
    )


def _one_query_each(camera: Camera, body: Body, queries: int, objects: int) -> Batch:
    """A batch in which every query has a scene to itself, with no more views than it needs."""
    batch = made_up_batch(camera, scenes=queries, goals=1, objects=objects if body.among_all else 3)
    pairs = torch.tensor([0, 1]).expand(queries, 1, 2)
    ((predicate, _, relevant, labelled),) = batch.turns
    asked = torch.zeros_like(labelled)
    asked[..., 2] = True
    return replace(batch, turns=((predicate, pairs, relevant, asked),))


def _seconds(work: Callable[[], None], device: torch.device, least: float) -> float:
    """Seconds of one call, the median of those that fit; the first counts only when it is alone."""
    clock = time.process_time if device.type == "cpu" else time.perf_counter
    taken: list[float] = []
    end = time.perf_counter() + least
    while not taken or time.perf_counter() < end:
        start = clock()
        work()
        if device.type != "cpu":
            torch.accelerator.synchronize(device)
        taken.append(clock() - start)
    return sorted(taken[1:] or taken)[len(taken[1:]) // 2]


def _start_counting(device: torch.device) -> int:
    """Forget the peak of the memory; what the process has now, where that is counted in."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    gc.collect()
    try:
        ctypes.CDLL(None).malloc_trim(0)  # what earlier bodies left would be used again, uncounted
        Path("/proc/self/clear_refs").write_text("5")
    except (OSError, AttributeError):  # not Linux, or not glibc
        return 0
    return _status("VmRSS") or 0


def _count(device: torch.device, before: int) -> int | None:
    """Most bytes that were in use since."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) - before
    peak = _status("VmHWM")
    return None if peak is None or not before else peak - before


def _status(key: str) -> int | None:
    """Bytes of an entry of the kernel's account of this process; None where there is none."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return None
    return next((int(line.split()[1]) * 1024 for line in lines if line.startswith(key)), None)
