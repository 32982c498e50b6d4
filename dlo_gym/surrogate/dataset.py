"""Training samples from rollouts: a state, an action, the change (Sections IV-B2 and VI-A1)."""

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from dlo_gym.surrogate.conditioning import groups
from dlo_gym.surrogate.simulation import Rollouts
from dlo_gym.surrogate.weights_file import Scales


class Batch(NamedTuple):
    """B samples in network units.

    Attributes:
        state: (B, 3 n) centerlines, mean-centred.
        actions: (B, 2, 7) of the clamps.
        change: (B, 3 n) of the centerlines.
        rods: (B, 4) groups of the rods.
    """

    state: Tensor
    actions: Tensor
    change: Tensor
    rods: Tensor


class Moves(NamedTuple):
    """B moves in world axes.

    Attributes:
        before: (B, n, 3) centerlines [m].
        change: (B, n, 3) of the centerlines [m].
        shift: (B, 2, 3) translations of the clamps [m].
        turn: (B, 2, 4) rotations of the clamps, wxyz with w >= 0.
        lengths: (B,) of the rods [m].
        rods: (B, 4) their groups.
    """

    before: Tensor
    change: Tensor
    shift: Tensor
    turn: Tensor
    lengths: Tensor
    rods: Tensor

    def exchanged(self, which: Tensor) -> "Moves":
        """The moves, of some rods (B,) with the ends exchanged."""
        before, change, shift, turn = (
            torch.where(which[:, None, None], values.flip(1), values) for values in self[:4]
        )
        return Moves(before, change, shift, turn, self.lengths, self.rods)


class RolloutDataset:
    """All states of some rollouts in memory; batches are drawn by indexing.

    Args:
        rollouts: as simulated.
        max_steps: the final state is up to this many steps from the first.
        noise: standard deviation of the noise on the input's coordinates [m].
        plain: samples as the paper has them: none to ``max_steps`` ahead, world axes, metres,
            quaternions. Else one to ``max_steps`` ahead or back, the equilibrium being the same
            from either side; mirrored and with the ends exchanged at random, which a uniform rod
            does not notice; and encoded as in ``encode``.
    """

    def __init__(
        self, rollouts: Rollouts, *, max_steps: int = 3, noise: float = 0.0, plain: bool = False
    ) -> None:
        self.positions = torch.from_numpy(rollouts.positions)
        self.clamps = torch.from_numpy(rollouts.clamps)
        self.lengths = torch.from_numpy(rollouts.lengths).float()
        known = [groups(rollouts.properties(i)) for i in range(len(rollouts.rods))]
        self.rods = torch.from_numpy(np.array(known)).float()
        self.max_steps, self.noise, self.plain = max_steps, noise, plain

    def __len__(self) -> int:
        """Number of rollouts."""
        return len(self.positions)

    def sample(self, size: int, generator: torch.Generator, scales: Scales) -> Batch:
        """A random batch."""
        moves = self.moves(size, generator)
        if self.noise:
            noise = self.noise * torch.randn(moves.before.shape, generator=generator)
            moves = moves._replace(before=moves.before + noise)
        if self.plain:
            return encode_plain(moves)
        moves = moves.exchanged(torch.rand(size, generator=generator) < 0.5)
        batch = encode(moves, scales)
        mirrored = torch.rand(size, generator=generator) < 0.5
        state, actions, change = (_mirror_some(values, mirrored) for values in batch[:3])
        return Batch(state, actions, change, batch.rods)

    def moves(self, size: int, generator: torch.Generator) -> Moves:
        """Random moves from one state of a rollout to another."""
        n_states = self.positions.shape[1]
        rollout = torch.randint(len(self), (size,), generator=generator)
        steps = torch.randint(
            0 if self.plain else 1, self.max_steps + 1, (size,), generator=generator
        )
        first = (torch.rand(size, generator=generator) * (n_states - steps)).long()
        last = first + steps
        if not self.plain:
            back = torch.rand(size, generator=generator) < 0.5
            first, last = torch.where(back, last, first), torch.where(back, first, last)
        before, after = self.positions[rollout, first], self.positions[rollout, last]
        turn = relative_quaternion(self.clamps[rollout, first], self.clamps[rollout, last])
        change = after - before
        return Moves(
            before, change, change[:, [0, -1]], turn, self.lengths[rollout], self.rods[rollout]
        )


def encode(moves: Moves, scales: Scales) -> Batch:
    """Network units, in rod lengths and seen along the heading.

    An action's seven numbers are the translation, and the cosine and the change of the clamp's
    tangent d3: the quaternion's part that matters, since no action turns the rod about its axis.
    """
    axes, lengths = heading(moves.before), moves.lengths[:, None, None]
    d3 = torch.stack(
        [moves.before[:, 1] - moves.before[:, 0], moves.before[:, -1] - moves.before[:, -2]], 1
    )
    d3 = d3 / torch.linalg.norm(d3, dim=-1, keepdim=True)
    turned = rotate(moves.turn, d3)
    cosine = (d3 * turned).sum(-1, keepdim=True)
    actions = [
        moves.shift @ axes / (scales.translation * lengths),
        cosine,
        (turned - d3) @ axes / scales.turn,
    ]  # fmt: skip
    centred = moves.before - moves.before.mean(1, keepdim=True)
    return Batch(
        (centred @ axes / (scales.position * lengths)).flatten(1),
        torch.cat(actions, -1),
        (moves.change @ axes / (scales.change * lengths)).flatten(1),
        moves.rods,
    )


def encode_plain(moves: Moves) -> Batch:
    """The paper's: metres and quaternions in world axes, mean-centred."""
    centred = moves.before - moves.before.mean(1, keepdim=True)
    actions = torch.cat([moves.shift, moves.turn], -1)
    return Batch(centred.flatten(1), actions, moves.change.flatten(1), moves.rods)


def heading(centerlines: Tensor) -> Tensor:
    """R_world_heading (B, 3, 3): z up, x along the horizontal part of the chord of (B, n, 3)."""
    chord = centerlines[:, -1] - centerlines[:, 0]
    c, s = (chord[:, :2] / torch.linalg.norm(chord[:, :2], dim=1, keepdim=True)).unbind(1)
    zero, one = torch.zeros_like(c), torch.ones_like(c)
    return torch.stack([c, -s, zero, s, c, zero, zero, zero, one], 1).view(-1, 3, 3)


def relative_quaternion(start: Tensor, end: Tensor) -> Tensor:
    """The rotation in world axes, wxyz (..., 4) with w >= 0, from orientation start to end."""
    w, v = start[..., :1], -start[..., 1:]
    a, b = end[..., :1], end[..., 1:]
    real = a * w - (b * v).sum(-1, keepdim=True)
    product = torch.cat([real, a * v + w * b + torch.linalg.cross(b, v)], -1)
    return torch.where(real < 0, -product, product)


def rotate(quaternions: Tensor, vectors: Tensor) -> Tensor:
    """Vectors (..., 3) turned by unit quaternions wxyz (..., 4)."""
    across = torch.linalg.cross(quaternions[..., 1:], vectors)
    return vectors + 2.0 * (
        quaternions[..., :1] * across + torch.linalg.cross(quaternions[..., 1:], across)
    )


def _mirror_some(values: Tensor, mirrored: Tensor) -> Tensor:
    """A batch's member, some samples seen in the mirror that stands along the heading."""
    signs = [1, -1, 1, 1, 1, -1, 1] if values.ndim == 3 else [1, -1, 1] * (values.shape[1] // 3)
    shape = (-1, *[1] * (values.ndim - 1))
    return torch.where(mirrored.view(shape), values * values.new_tensor(signs), values)
