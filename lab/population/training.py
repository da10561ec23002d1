"""Training of the network of `lensmodel.neural` on a library of lenses; needs PyTorch, resumable at any time.

The batch is made in NumPy by the very functions that the product uses. The loss is the relative L2 distance
of kernels, the r.m.s. difference of their MTFs, and how far the told errors are from those made.
"""

from __future__ import annotations

import io
import json
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from lab.images import zone_masks
from lab.population.sets import Lens, Set, draw_set, load_library
from lensmodel.core.files import write_atomically
from lensmodel.neural import network
from lensmodel.neural.network import (
    BLOCK,
    COARSE,
    CONDITION,
    DISTANCES,
    FINE,
    LENGTH,
    PLACE,
    RELATION,
    RINGS,
    FieldNetwork,
)

WIDTH, HEADS, HIDDEN, COMPONENTS = 192, 6, 384, 224
ENCODER_BLOCKS, DECODER_BLOCKS = 2, 3
_OUTER: Final = int(network.outer_cells().sum())
_LOGITS: Final = FINE * FINE + _OUTER

_SET_SIZES: Final = ((1, 2, 4, 8, 16, 32, 64, 110), (0.05, 0.04, 0.06, 0.12, 0.18, 0.22, 0.2, 0.13))
_GREEN_WEIGHT: Final = 1.4
_ERROR_RATE: Final = 1e-3  # of learning in `train_errors`
_TOLD_WEIGHT, _RING_WEIGHT = 0.1, 0.05
_DROPPED: Final = 0.1  # share of values left out, so that no lens is recognised by a few of its numbers
_AVERAGED: Final = 0.004  # pace of the moving average of weights
_SAVED_SECONDS: Final = 240.0


class Attention(nn.Module):
    """`FieldNetwork._block`: attention with relations, then two layers."""

    def __init__(self) -> None:
        super().__init__()
        width = WIDTH // HEADS
        self.normal_query, self.normal_memory, self.normal_inner = (nn.LayerNorm(WIDTH) for _ in range(3))
        self.q, self.kv, self.out = (nn.Linear(WIDTH, n * WIDTH) for n in (1, 2, 1))
        self.inner, self.outer = nn.Linear(WIDTH, 2 * WIDTH), nn.Linear(2 * WIDTH, WIDTH)
        self.relation_key = nn.Parameter(torch.randn(HEADS, width, RELATION) * 0.02)
        self.relation_value = nn.Parameter(torch.randn(HEADS, RELATION, width) * 0.02)
        near = torch.zeros(DISTANCES, HEADS)
        near[0, :2] = torch.tensor([25.0, 5.0])
        near[1, 2:4] = torch.tensor([60.0, 10.0])
        near[2:] = 0.5
        self.distance = nn.Parameter(near)
        self.nothing = nn.Parameter(torch.zeros(HEADS))

    def forward(self, x: Tensor, memory: Tensor, relation: Tensor, hidden: Tensor | None) -> Tensor:
        """Attend from x (b, q, d) to memory (b, n, d), but for `hidden` pairs (b, q, n)."""
        b, q, _ = x.shape
        split = lambda v: v.view(b, -1, HEADS, WIDTH // HEADS).transpose(1, 2)  # noqa: E731 - (b, h, n, w)
        query = split(self.q(self.normal_query(x)))
        key, value = (split(v) for v in self.kv(self.normal_memory(memory)).chunk(2, -1))
        score = query @ key.transpose(-1, -2) / math.sqrt(WIDTH // HEADS)
        directed = query @ self.relation_key.to(query.dtype)  # (b, h, q, f)
        score = score + torch.einsum("bhqf,bqnf->bhqn", directed, relation)
        score = score - (relation[..., :DISTANCES] @ self.distance.abs().to(relation.dtype)).permute(
            0, 3, 1, 2
        )
        if hidden is not None:
            score = score.masked_fill(hidden[:, None], -1e4)
        nothing = self.nothing.view(1, HEADS, 1, 1).expand(b, -1, q, 1).to(score.dtype)
        attention = torch.cat([score, nothing], -1).float().softmax(-1)[..., :-1].to(value.dtype)
        taken = attention @ value
        seen = torch.einsum("bhqn,bqnf->bhqf", attention, relation)
        taken = taken + seen @ self.relation_value.to(seen.dtype)
        x = x + self.out(taken.transpose(1, 2).reshape(b, q, WIDTH))
        return x + self.outer(functional.gelu(self.inner(self.normal_inner(x))))


class Network(nn.Module):
    """The network of `lensmodel.neural.network`, with the same names of weights."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(LENGTH))
        self.register_buffer("spread", torch.ones(LENGTH))
        self.enter = nn.Linear(LENGTH + CONDITION + PLACE, HIDDEN)
        self.widen = nn.ModuleDict(
            {"normal": nn.LayerNorm(HIDDEN), "0": nn.Linear(HIDDEN, HIDDEN), "1": nn.Linear(HIDDEN, HIDDEN)}
        )
        self.narrow = nn.ModuleDict({"normal": nn.LayerNorm(HIDDEN), "linear": nn.Linear(HIDDEN, WIDTH)})
        self.ask = nn.ModuleDict({"0": nn.Linear(PLACE + CONDITION, WIDTH), "1": nn.Linear(WIDTH, WIDTH)})
        self.encoder = nn.ModuleList([Attention() for _ in range(ENCODER_BLOCKS)])
        self.decoder = nn.ModuleList([Attention() for _ in range(DECODER_BLOCKS)])
        self.kernel = nn.ModuleDict(
            {
                "normal": nn.LayerNorm(WIDTH),
                "0": nn.Linear(WIDTH, HIDDEN),
                "1": nn.Linear(HIDDEN, COMPONENTS),
                "2": nn.Linear(COMPONENTS, 3 * _LOGITS),
            }
        )
        self.error = nn.ModuleDict(
            {"normal": nn.LayerNorm(WIDTH), "0": nn.Linear(WIDTH, 96), "1": nn.Linear(96, 3 + 3 * RINGS)}
        )

    def latents(self, batch: Mapping[str, Tensor]) -> Tensor:
        """What the samples say of each query, (b, q, WIDTH)."""
        x = ((batch["statistics"] - self.mean) / self.spread).clamp(-6, 6)
        x = functional.dropout(x, _DROPPED, self.training)
        t = functional.gelu(self.enter(torch.cat([x, batch["condition"], batch["place"]], -1)))
        t = t + self.widen["1"](functional.gelu(self.widen["0"](self.widen["normal"](t))))
        t = functional.dropout(self.narrow["linear"](self.narrow["normal"](t)), _DROPPED, self.training)
        for block in self.encoder:
            t = block(t, t, batch["among"], batch["apart"])
        q = self.ask["1"](
            functional.gelu(self.ask["0"](torch.cat([batch["query_place"], batch["query_condition"]], -1)))
        )
        for block in self.decoder:
            q = block(q, t, batch["relation"], batch["unused"])
        return q.float()

    def shares(self, q: Tensor) -> Tensor:
        """Kernels (b, q, 3, _LOGITS) of latents."""
        hidden = functional.gelu(self.kernel["0"](self.kernel["normal"](q)))
        hidden = self.kernel["1"](functional.dropout(hidden, _DROPPED, self.training))
        out: Tensor = self.kernel["2"](hidden).view(*q.shape[:2], 3, _LOGITS).softmax(-1)
        return out

    def told(self, q: Tensor) -> Tensor:
        """Log errors (b, q, 3 + 3 RINGS) of the kernels of latents."""
        out: Tensor = self.error["1"](functional.gelu(self.error["0"](self.error["normal"](q))))
        return out

    def forward(self, batch: Mapping[str, Tensor]) -> tuple[Tensor, Tensor]:
        """Shares of kernels and told log errors of a batch."""
        q = self.latents(batch)
        with torch.autocast(q.device.type, enabled=False):
            return self.shares(q), self.told(q)

    def exported(self) -> dict[str, NDArray[np.float16]]:
        """Weights under the names that the product uses."""
        return {
            name.replace("narrow.linear", "narrow"): value.detach().numpy().astype(np.float16)
            for name, value in self.state_dict().items()
        }


def _ring_matrix() -> NDArray[np.float32]:
    """Averages over rings of a half plane of FINE x FINE frequencies, (RINGS, frequencies)."""
    f = np.hypot(np.fft.fftfreq(FINE)[:, None], np.fft.rfftfreq(FINE)[None]).ravel()
    ring = np.minimum((f * 16).astype(int), RINGS)
    matrix = np.stack([ring == i for i in range(RINGS)]).astype(np.float32)
    return matrix / matrix.sum(1, keepdims=True)


_RING_MATRIX: Final = torch.from_numpy(_ring_matrix())
_OUTER_INDEX: Final = torch.from_numpy(np.nonzero(network.outer_cells().ravel())[0])


def losses(shares: Tensor, truth: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Relative L2 distance, r.m.s. difference of MTFs, r.m.s. error of the OTF by ring; (b, q, 3[, 8])."""
    difference = shares - truth
    fine, outer = difference[..., : FINE * FINE], difference[..., FINE * FINE :]
    area = 1.0 / BLOCK**2
    squared = fine.square().sum(-1) + area * outer.square().sum(-1)
    power = truth[..., : FINE * FINE].square().sum(-1) + area * truth[..., FINE * FINE :].square().sum(-1)
    relative = torch.sqrt(squared / power + 1e-5)

    def transforms(v: Tensor) -> tuple[Tensor, Tensor]:
        inner = torch.fft.rfft2(v[..., : FINE * FINE].unflatten(-1, (FINE, FINE)))
        coarse = v.new_zeros(*v.shape[:-1], COARSE * COARSE)
        coarse[..., _OUTER_INDEX] = v[..., FINE * FINE :]
        edge = (COARSE - FINE // BLOCK) // 2
        grid = coarse.unflatten(-1, (COARSE, COARSE))
        cells = (
            v[..., : FINE * FINE].unflatten(-1, (FINE // BLOCK, BLOCK, FINE // BLOCK, BLOCK)).sum((-3, -1))
        )
        grid[..., edge:-edge, edge:-edge] = cells
        return inner, torch.fft.rfft2(grid)

    (inner, wide), (true_inner, true_wide) = transforms(shares), transforms(truth)
    mtf = torch.sqrt((inner.abs() - true_inner.abs()).square().mean((-1, -2)) + 1e-6)
    mtf = mtf + 0.5 * torch.sqrt((wide.abs() - true_wide.abs()).square().mean((-1, -2)) + 1e-6)
    rings = torch.sqrt(
        (inner - true_inner).abs().square().flatten(-2) @ _RING_MATRIX.T.to(shares.device) + 1e-7
    )
    return relative, mtf, rings


def collate(sets: list[Set]) -> dict[str, Tensor]:
    """One batch of sets of any sizes; missing samples are masked."""
    size = max(len(s.xy) for s in sets)

    def padded(values: list[NDArray[Any]]) -> NDArray[Any]:
        return np.stack([np.pad(v, [(0, size - len(v))] + [(0, 0)] * (v.ndim - 1)) for v in values])

    missing = np.stack([np.arange(size) >= len(s.xy) for s in sets])
    xy, settings = padded([s.xy for s in sets]), padded([s.settings for s in sets])
    photo = padded([s.photo for s in sets])
    query_xy = np.stack([s.query_xy for s in sets])
    query_settings = np.stack([s.query_settings for s in sets])
    apart = (photo[:, :, None] != photo[:, None]) | missing[:, None]
    out = {
        "statistics": padded([s.statistics for s in sets]),
        "place": network.place_features(xy),
        "condition": network.condition_features(settings),
        "among": network.relation_features(xy, settings, xy, settings),
        "query_place": network.place_features(query_xy),
        "query_condition": network.condition_features(query_settings),
        "relation": network.relation_features(query_xy, query_settings, xy, settings),
        "truth": np.stack([s.truth for s in sets]).astype(np.float32),
    }
    tensors = {name: torch.from_numpy(np.ascontiguousarray(value, np.float32)) for name, value in out.items()}
    tensors["apart"] = torch.from_numpy(apart)
    tensors["unused"] = torch.from_numpy(np.repeat(missing[:, None], query_xy.shape[1], 1))
    return tensors


def batches(lenses: list[Lens], rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
    """Endless batches of about 1024 samples."""
    while True:
        samples = int(rng.choice(_SET_SIZES[0], p=_SET_SIZES[1]))
        count = int(np.clip(1024 // samples, 10, 72))
        queries = 2 if samples <= 2 else 4 if samples <= 4 else 6 if samples <= 16 else 12
        chosen = rng.integers(0, len(lenses), count)
        yield collate([draw_set(lenses[i], samples, queries, rng) for i in chosen])


def start(network: Network, lenses: list[Lens]) -> None:
    """Set the scale of inputs, and let the output begin as the principal components of log kernels."""
    statistics = np.concatenate([lens.statistics for lens in lenses[:600]]).astype(np.float32)
    network.mean[:] = torch.from_numpy(statistics.mean(0))
    network.spread[:] = torch.from_numpy(statistics.std(0) + 0.02)
    kernels = np.concatenate([lens.truth[:, ::4].reshape(-1, 3 * _LOGITS) for lens in lenses[:800]])
    logs = np.log(kernels.astype(np.float32) + 1e-4)
    mean = logs.mean(0)
    _, s, v = torch.svd_lowrank(torch.from_numpy(logs - mean), COMPONENTS, niter=3)
    last = network.kernel["2"]
    last.weight.data[:] = v * (s / math.sqrt(len(logs)))
    last.bias.data[:] = torch.from_numpy(mean)
    network.kernel["1"].weight.data *= 0.3


@torch.no_grad()
def held_out(network: Network, lenses: list[Lens], samples: int) -> dict[str, float]:
    """Errors on lenses that were not trained on: of each colour, of green by zone, and as told."""
    rng = np.random.default_rng(1)
    relative, told, radius = [], [], []
    for first in range(0, len(lenses), 20):
        queries, some = 1 if samples == 1 else 24, lenses[first : first + 20]
        sets = [draw_set(lens, samples, queries, rng, varied=False) for lens in some]
        batch = collate(sets)
        shares, told_log = network(batch)
        relative.append(losses(shares, batch["truth"])[0].reshape(-1, 3))
        told.append(told_log[..., :3].exp().reshape(-1, 3))
        radius.append(np.concatenate([np.hypot(*s.query_xy.T) for s in sets]))
    r, t, at = torch.cat(relative).numpy(), torch.cat(told).numpy(), np.concatenate(radius)
    out = {name: float(r[:, i].mean()) for i, name in enumerate("rgb")}
    out |= {zone: float(r[inside, 1].mean()) for zone, inside in zone_masks(at).items() if inside.any()}
    right = np.abs(np.log(t[:, 1] / r[:, 1])) < math.log(1.5)
    return {**out, "told": float(t[:, 1].mean()), "told_right": float(right.mean())}


def _print_figures(figures: Mapping[int, Mapping[str, float]]) -> None:
    for n, values in figures.items():
        print(f"held out, {n} samples: " + " ".join(f"{k} {v:.3f}" for k, v in values.items()), flush=True)


def export(network: Network, provenance: Mapping[str, Any], path: Path) -> None:
    """Write weights as the product reads them."""
    text = np.frombuffer(json.dumps(dict(provenance)).encode(), np.uint8)
    data = io.BytesIO()
    arrays: dict[str, Any] = {"provenance": text, **network.exported()}
    np.savez_compressed(data, **arrays)
    write_atomically(path, data.getvalue())


@dataclass
class Sitting:
    """The state of training, which outlives the process: it goes on where the last sitting ended."""

    folder: Path
    device: torch.device
    network: Network
    average: Network  # moving average of the weights: what is judged and exported
    optimiser: torch.optim.Optimizer
    minutes: float = 0.0
    step: int = 0
    curve: list[dict[str, Any]] = field(default_factory=list)

    @classmethod
    def begin(cls, folder: Path, lenses: list[Lens], rate: float) -> Sitting:
        """Read the state in the folder, or start anew."""
        device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        network, average = Network(), Network()
        stored = folder / "state.pt"
        state = torch.load(stored, weights_only=False, map_location="cpu") if stored.exists() else None
        if state is None:
            start(network, lenses)
        else:
            network.load_state_dict(state["network"])
        average.load_state_dict(network.state_dict() if state is None else state["average"])
        network.to(device)
        optimiser = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=0.03, betas=(0.9, 0.98))
        sitting = cls(folder, device, network, average.to(device), optimiser)
        if state is not None:
            optimiser.load_state_dict(state["optimiser"])
            sitting.minutes, sitting.step, sitting.curve = state["minutes"], state["step"], state["curve"]
        return sitting

    def learn(self, batch: Mapping[str, Tensor], rate: float) -> float:
        """Take one step; returns the mean relative error of green."""
        for part in self.optimiser.param_groups:
            part["lr"] = rate * min(1.0, (self.step + 1) / 200)
        batch = {name: value.to(self.device) for name, value in batch.items()}
        with torch.autocast(self.device.type, torch.bfloat16):
            shares, told = self.network(batch)
        relative, mtf, rings = losses(shares, batch["truth"])
        weight = relative.new_tensor([1.0, _GREEN_WEIGHT, 1.0])
        loss = (relative * weight).mean() + (mtf * weight).mean()
        loss = loss + _told_loss(told, relative, rings)
        self.optimiser.zero_grad()
        loss.backward()
        if torch.isfinite(nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)):
            self.optimiser.step()
        pace = _AVERAGED if self.step > 1 / _AVERAGED else 0.05
        with torch.no_grad():
            for slow, fast in zip(self.average.parameters(), self.network.parameters(), strict=True):
                slow.lerp_(fast, pace)
        self.step += 1
        return float(relative.detach()[..., 1].mean())

    def save(self, apart: list[Lens], facts: Mapping[str, Any]) -> None:
        """Judge, and write `state.pt` to go on from and `weights.npz` as the product reads them."""
        average = self.average.to("cpu").eval()
        figures = {n: held_out(average, apart, n) for n in (1, 8, 64)}
        _print_figures(figures)
        known = {"minutes": self.minutes, "step": self.step, "lenses": facts["lenses"]}
        self.curve.append(known | {"figures": figures})
        part = self.folder / "state.part"
        torch.save(
            {
                "network": self.network.state_dict(), "average": average.state_dict(),
                "optimiser": self.optimiser.state_dict(), "minutes": self.minutes, "step": self.step,
                "curve": self.curve,
            },
            part,
        )  # fmt: skip
        part.replace(self.folder / "state.pt")
        provenance = {**facts, "steps": self.step, "minutes": round(self.minutes, 1), "curve": self.curve}
        export(average, provenance, self.folder / "weights.npz")
        self.average = average.to(self.device)


def train(
    folder: Path, minutes: float, *, total_minutes: float, rate: float, threads: int, seed: int, code: str
) -> None:
    """Train from where the last sitting ended on `lenses` of the folder, those added meanwhile too.

    `rate` is the highest of learning, and falls as half a cosine over `total_minutes` of all sittings.
    """
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    known: set[str] = set()
    lenses = load_library(folder / "lenses", known)
    apart = load_library(folder / "held-out", set())
    sitting = Sitting.begin(folder, lenses, rate)
    print(f"{len(lenses)} lenses, {len(apart)} held out, on {sitting.device}", flush=True)
    source = batches(lenses, np.random.default_rng([seed, sitting.step]))
    before, began = sitting.minutes, time.monotonic()
    reported = saved = began
    recent: list[float] = []
    while sitting.minutes < before + minutes:
        share = min(sitting.minutes / total_minutes, 1.0)
        recent.append(sitting.learn(next(source), rate * (0.49 * (1 + math.cos(math.pi * share)) + 0.02)))
        now = time.monotonic()
        sitting.minutes = before + (now - began) / 60
        if now - reported > 60:
            reported = now
            green = float(np.mean(recent[-300:]))
            print(f"{sitting.minutes:.1f} min, {len(lenses)} lenses, green {green:.3f}", flush=True)
        if now - saved > _SAVED_SECONDS or sitting.minutes >= before + minutes:
            facts = {"code": code, "seed": seed, "lenses": len(lenses), "shards": sorted(known)}
            sitting.save(apart, facts)
            saved = time.monotonic()
            lenses += load_library(folder / "lenses", known)


def train_errors(folder: Path, minutes: float, *, threads: int, seed: int) -> None:
    """Train what tells the errors anew, on lenses that no sitting has learned kernels from."""
    torch.set_num_threads(threads)
    torch.manual_seed(seed)
    lenses = load_library(folder / "lenses-of-errors", set())
    apart = load_library(folder / "held-out", set())
    network = Sitting.begin(folder, lenses, 1e-3).average.eval()
    head = list(network.error.parameters())
    optimiser = torch.optim.AdamW(head, lr=_ERROR_RATE, weight_decay=0.03)
    source = batches(lenses, np.random.default_rng([seed, len(lenses)]))
    began, share = time.monotonic(), 0.0
    while share < 1.0:
        batch = next(source)
        with torch.no_grad():
            latents = network.latents(batch)
            relative, _, rings = losses(network.shares(latents), batch["truth"])
        for part in optimiser.param_groups:
            part["lr"] = _ERROR_RATE * (0.5 * (1 + math.cos(math.pi * share)) + 0.01)
        optimiser.zero_grad()
        _told_loss(network.told(latents), relative, rings).backward()
        optimiser.step()
        share = (time.monotonic() - began) / 60 / minutes
    figures = {n: held_out(network, apart, n) for n in (1, 8, 64)}
    _print_figures(figures)
    path = folder / "weights.npz"
    facts = FieldNetwork.from_bytes(path.read_bytes()).provenance
    export(network, {**facts, "lenses_of_errors": len(lenses), "told": figures}, path)


def _told_loss(told: Tensor, relative: Tensor, rings: Tensor) -> Tensor:
    """Distance of told log errors from those made: their medians are learned."""
    ring_told = told[..., 3:].unflatten(-1, (3, RINGS))
    loss = _TOLD_WEIGHT * (told[..., :3] - relative.detach().log()).abs().mean()
    return loss + _RING_WEIGHT * (ring_told - rings.detach().log()).abs().mean()
