"""Layers that more than one body is made of.

Shape suffixes: B scenes, N objects (padded), G goals, T trios, L tokens, D width,
C channels or columns, R rows, H heads.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F
from torch.nn.utils import convert_conv2d_weight_memory_format

from relevance.models.config import PATCH, Answer, Sight
from relevance.models.tracing import attend, reshaped, shares, tracing
from relevance.networks import GEOMETRY
from relevance.scene import Camera


class Attention(nn.Module):
    """Pre-norm transformer layer on `scaled_dot_product_attention`, with our own masks.

    Told what lies between every two tokens, rows of width `between`, that has a say in who looks
    at whom, and rows carry along what lies between them and what they look at.
    """

    def __init__(self, width: int, heads: int, expansion: int = 4, between: int = 0) -> None:
        super().__init__()
        self.heads = heads
        self.norm_in, self.norm_mid = nn.LayerNorm(width), nn.LayerNorm(width)
        self.qkv, self.out = nn.Linear(width, 3 * width), nn.Linear(width, width)
        if between:
            self.say = nn.Linear(between, heads)
            self.carried = nn.Linear(heads * between, width, bias=False)
        self.mlp = nn.Sequential(
            nn.Linear(width, expansion * width), nn.GELU(), nn.Linear(expansion * width, width)
        )

    def forward(
        self, x: Tensor, allowed: Tensor | None = None, between: Tensor | None = None
    ) -> Tensor:
        """x (B, L, D); allowed (B or 1, L, L) bool: row may look at column (None: at all); between
        (B or C, L, L, E), each for B / C rows of x that follow each other."""
        if tracing() and allowed is None:
            if between is None:
                x = x + self.out(attend(self.norm_in(x), self.qkv, self.heads))
            else:
                say = self.say(between).permute(0, 3, 1, 2)
                share, seen = shares(self.norm_in(x), self.qkv, self.heads, say)
                carried = reshaped(share.transpose(1, 2) @ between, (0, 0, -1))
                x = x + self.out(seen) + self.carried(carried)
            return x + self.mlp(self.norm_mid(x))
        batch, length, width = x.shape
        qkv = self.qkv(self.norm_in(x)).view(batch, length, 3, self.heads, width // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        mask = None if allowed is None else allowed[:, None]
        if between is None:
            seen = F.scaled_dot_product_attention(q, k, v, attn_mask=mask)
            x = x + self.out(seen.transpose(1, 2).reshape(batch, length, width))
            return x + self.mlp(self.norm_mid(x))
        logits = q @ k.transpose(2, 3) / math.sqrt(width // self.heads)
        scenes, each = len(between), batch // len(between)
        say = self.say(between).permute(0, 3, 1, 2)  # (C, H, L, L)
        logits = (logits.unflatten(0, (scenes, each)) + say[:, None]).flatten(0, 1)
        if mask is not None:
            logits = logits.masked_fill(~mask, -math.inf)
        share_BHLL = logits.softmax(-1)
        seen = (share_BHLL @ v).transpose(1, 2).reshape(batch, length, width)
        # What lies between is the same for all that ask: (C, L, B / C x H, L) @ (C, L, L, E).
        by_row = share_BHLL.unflatten(0, (scenes, each)).permute(0, 3, 1, 2, 4).flatten(2, 3)
        carried = (by_row @ between).unflatten(2, (each, self.heads)).permute(0, 2, 1, 3, 4)
        x = x + self.out(seen) + self.carried(carried.flatten(0, 1).flatten(2))
        return x + self.mlp(self.norm_mid(x))

    def looks(self, x: Tensor, rows: slice, columns: slice) -> Tensor:
        """Log of the share (B, R, C) of these rows' attention that goes to each of the columns.

        The mean over the heads, so that not all need to look there; columns among themselves.
        """
        batch, length, width = x.shape
        qkv = self.qkv(self.norm_in(x)).view(batch, length, 3, self.heads, width // self.heads)
        q, k = qkv[:, rows, 0].transpose(1, 2), qkv[:, columns, 1].transpose(1, 2)
        logits = (q @ k.transpose(2, 3)).float() / math.sqrt(width // self.heads)
        return logits.log_softmax(-1).logsumexp(1) - math.log(self.heads)


class Extractor(nn.Module):
    """The paper's predicate extractor: [subject, reference, query] -> two hidden layers -> score.

    The first layer is three matrices, one a role, so each object goes through each only once.
    """

    def __init__(self, width: int, hidden: int) -> None:
        super().__init__()
        self.subject = nn.Linear(width, hidden)
        self.reference = nn.Linear(width, hidden, bias=False)
        self.query = nn.Linear(width, hidden, bias=False)
        self.second, self.score = nn.Linear(hidden, hidden), nn.Linear(hidden, 1)

    def forward(self, tokens: Tensor, goals: Tensor) -> Tensor:
        """Scores (B, G, N) from tokens (B, N, D) for goals (B, G, 2)."""
        pair = pick(self.subject(tokens), goals[..., 0])
        pair = pair + pick(self.reference(tokens), goals[..., 1])
        hidden = F.relu(pair[:, :, None] + self.query(tokens)[:, None])
        return self.score(F.relu(self.second(hidden))).squeeze(-1)

    def of_trios(self, tokens: Tensor) -> Tensor:
        """Scores (...) from the tokens (..., 3, D) of subject, reference and query."""
        subject, reference, query = tokens.unbind(-2)
        hidden = F.relu(self.subject(subject) + self.reference(reference) + self.query(query))
        return self.score(F.relu(self.second(hidden))).squeeze(-1)


def unshuffled(layers: nn.Sequential, image: Tensor) -> Tensor:
    """`layers`, which begin with a PixelUnshuffle and a convolution of 1x1, of image - 0.5.

    The two are one convolution whose stride is its size, and it shifts the pixels, too: two
    copies of the image less. What follows is faster with the channels last.
    """
    cell, first, rest = layers[0], layers[1], layers[2:]
    assert isinstance(cell, nn.PixelUnshuffle)
    assert isinstance(first, nn.Conv2d)
    assert first.bias is not None
    edge = cell.downscale_factor
    weight = first.weight.view(first.out_channels, -1, edge, edge)
    shift = first.bias - weight.sum((1, 2, 3)) / 2
    found = F.conv2d(image, weight, shift, stride=edge)
    return rest(found if tracing() else found.contiguous(memory_format=torch.channels_last))


def small_cnn(channels: int, widths: tuple[int, int, int], width: int) -> nn.Sequential:
    """A 32x32 picture to a vector of `width`."""
    a, b, c = widths
    layers = nn.Sequential(
        nn.Conv2d(channels, a, 4, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(a, b, 4, stride=2, padding=1),
        nn.ReLU(),
        nn.Conv2d(b, c, 4, stride=2, padding=1),
        nn.ReLU(),
        nn.Flatten(),
        nn.Linear(c * (PATCH // 8) ** 2, width),
        nn.ReLU(),
    )
    # Learned so, they cost a quarter less on a CPU. (Not all convolutions: those of 1x1 with a
    # stride corrupt memory in torch 2.13.)
    return convert_conv2d_weight_memory_format(layers, torch.channels_last)


def extractor(heads: nn.ModuleDict, name: str) -> Extractor:
    """The extractor of a predicate."""
    found = heads[name]
    assert isinstance(found, Extractor)
    return found


def residual(dimensions: int, blocks: Sequence[int], channels: int) -> tuple[nn.Module, int]:
    """A ResNet over pictures or stacks of them (B, 3, ...), and the width of what it gives (B, C).

    Group norm in the place of batch norm: a batch has few scenes, many of its views are padding,
    and what a scene gets must not depend on who else is in the batch.
    """
    # Here and not above: monai takes seconds to import.
    from monai.networks.nets.resnet import ResNet

    planes = [channels * 2**stage for stage in range(4)]
    net = ResNet(
        block="basic",
        # monai's has four stages; those that are not wanted go.
        layers=[*blocks, *[1] * (4 - len(blocks))],
        block_inplanes=planes,
        spatial_dims=dimensions,
        n_input_channels=3,
        conv1_t_stride=2,
        feed_forward=False,
        norm=("group", {"num_groups": 8}),
    )
    for stage in range(len(blocks), 4):
        setattr(net, f"layer{stage + 1}", nn.Identity())
    return net, planes[len(blocks) - 1]


def each_trio(
    look: Callable[[Tensor, Tensor], Answer], goals: Tensor, asked: Tensor, at_once: int
) -> Answer:
    """The answer of a body that looks at subject, reference and query together.

    `look` answers for the scenes (T,) and the places (T, 3) in them of T trios, at most
    `at_once` of them; what is not `asked` (B, G, N) costs nothing and scores 0.
    """
    none = torch.zeros(asked.shape, device=goals.device)
    places = scene_T, goal_T, query_T = asked.nonzero(as_tuple=True)
    if not len(scene_T):
        return Answer(scores=none)
    trios_T3 = torch.cat([goals[scene_T, goal_T], query_T[:, None]], dim=1)
    parts = zip(scene_T.split(at_once), trios_T3.split(at_once), strict=True)
    answers = [look(*part) for part in parts]
    scores = none.index_put(places, torch.cat([answer.scores for answer in answers]).float())
    return Answer(scores=scores, sight=_joined([a.sight for a in answers if a.sight]))


def answer_trios(
    head: Extractor,
    taught: Taught | None,
    tokens: Tensor,
    scene: Tensor,
    trios: Tensor,
    attention: Tensor | None = None,
) -> Answer:
    """Scores (T,) from embeddings (T, 3, D) of the trios (T, 3), and in training what they say."""
    sight = None
    if taught is not None and taught.training:
        sight = taught(tokens, scene[:, None], trios, attention)
    return Answer(scores=head.of_trios(tokens), sight=sight)


def _joined(sights: Sequence[Sight]) -> Sight | None:
    """All looks as one; None when there are none."""
    if not sights:
        return None
    seen = [sight.attention for sight in sights if sight.attention is not None]
    return Sight(
        scene=torch.cat([sight.scene for sight in sights]),
        place=torch.cat([sight.place for sight in sights]),
        geometry=torch.cat([sight.geometry for sight in sights]),
        match=torch.cat([sight.match for sight in sights]),
        attention=torch.cat(seen) if seen else None,
        grid=sights[0].grid,
    )


class Taught(nn.Module):
    """What an object's embedding says of it, so that masks and poses can teach it to look."""

    def __init__(self, width: int, camera: Camera) -> None:
        super().__init__()
        self.grid = camera.height // PATCH, camera.width // PATCH
        self.geometry = nn.Sequential(
            nn.Linear(width, width), nn.GELU(), nn.Linear(width, GEOMETRY)
        )
        self.match = nn.Linear(width, math.prod(self.grid))

    def forward(
        self, tokens: Tensor, scene: Tensor, place: Tensor, attention: Tensor | None = None
    ) -> Sight:
        """From embeddings (..., D) of the objects at these places (...) of scenes (...)."""
        return Sight(
            scene=scene.expand_as(place).flatten(),
            place=place.flatten(),
            geometry=self.geometry(tokens).flatten(0, -2),
            match=self.match(tokens).flatten(0, -2),
            attention=None if attention is None else attention.flatten(0, -2),
            grid=self.grid,
        )


def pick(x: Tensor, index: Tensor) -> Tensor:
    """Rows of x (B, N, D) at index (B, ...): (B, ..., D)."""
    if tracing():
        return x[0][index]
    rows = x.gather(1, index.flatten(1)[..., None].expand(-1, -1, x.shape[-1]))
    return rows.view(*index.shape, x.shape[-1])


def columns(present: Tensor) -> Tensor | None:
    """Attention mask (B, N, N): everyone may look at the objects that exist, and at itself.

    None while a graph is traced: there all objects exist.
    """
    if tracing():
        return None
    itself = torch.eye(present.shape[1], dtype=torch.bool, device=present.device)
    return present[:, None, :] | itself
