"""The paper's network (Section IV-B1, Fig. 3), and the form of it that is shipped."""

from itertools import islice

import numpy as np
import torch
from torch import Tensor, nn

from dlo_gym.surrogate.conditioning import N_GROUPS, N_TERMS, Conditioning, Float32
from dlo_gym.surrogate.dataset import Batch
from dlo_gym.surrogate.weights_file import ACTION_SIZE, DEPTHS, Layers

HIDDEN = 256
EMBEDDING = (32, 16)
NOISE_FLOOR = 0.02  # of the whitening, in units of the network's input


class DloNetwork(nn.Module):
    """State block, action block shared by both clamps, prediction block.

    Args:
        n_nodes: of the rod.
        hidden: width of the state and prediction blocks, twice that of the action block.
        activation: between the layers.
    """

    def __init__(
        self, n_nodes: int, hidden: int = HIDDEN, activation: type[nn.Module] = nn.ReLU
    ) -> None:
        super().__init__()
        size, half = 3 * n_nodes, hidden // 2
        self.state = _layers(size, hidden, hidden, hidden, activation=activation)
        self.action = _layers(ACTION_SIZE, half, half, activation=activation)
        widths = (2 * hidden, hidden, hidden, hidden, size)
        self.prediction = nn.Sequential(*list(_layers(*widths, activation=activation))[:-1])

    def forward(self, state: Tensor, actions: Tensor) -> Tensor:
        """The change (B, 3 n) of states (B, 3 n) under actions (B, 2, 7), in network units."""
        return self.prediction(torch.cat([self.state(state), self.action(actions).flatten(1)], 1))


class RelativeNetwork(nn.Module):
    """The paper's network between a whitened input and a linear first guess, told of the rod.

    The predicted change is ``guess(A) + f(S, A) - f(S, 0)``: nothing moves unless a clamp does.
    The state enters ``f`` in whitened principal components, because the bends that matter are
    small beside the rod's extent; exported weights contain the whitening. An embedding of the rod's
    groups scales and shifts the units of every layer, and turns the guess (``conditioning.py``).
    SiLU takes ReLU's place: a rod's answer is smooth.
    """

    state_mean: Tensor
    whitening: Tensor
    guess: Tensor
    null: Tensor
    low: Tensor
    high: Tensor

    def __init__(self, n_nodes: int, hidden: int = HIDDEN) -> None:
        super().__init__()
        size = 3 * n_nodes
        self.network = f = DloNetwork(n_nodes, hidden, nn.SiLU)
        self.embedding = _layers(N_GROUPS, *EMBEDDING, activation=nn.ReLU)
        blocks = (f.state, f.action, f.prediction)
        layers = [m for block in blocks for m in block.children() if isinstance(m, nn.Linear)]
        self.units = [layer.out_features for layer in layers]
        self.modulation = nn.Linear(EMBEDDING[-1], 2 * sum(self.units))
        with torch.no_grad():
            self.modulation.weight.mul_(0.1)
            self.modulation.bias.zero_()
        self.register_buffer("state_mean", torch.zeros(size))
        self.register_buffer("whitening", torch.eye(size))
        self.register_buffer("guess", torch.zeros(N_TERMS, 2 * ACTION_SIZE, size))
        self.register_buffer("low", torch.zeros(N_GROUPS))
        self.register_buffer("high", torch.ones(N_GROUPS))
        self.register_buffer("null", null_action(), persistent=False)

    def fit(self, batch: Batch) -> None:
        """Ranges of the groups, whitening and first guess from samples."""
        state, actions, change, rods = batch
        self.low, self.high = rods.amin(0), rods.amax(0)
        self.state_mean = state.mean(0)
        variances, components = torch.linalg.eigh(torch.cov(state.T.double()))
        self.whitening = (components / (variances + NOISE_FLOOR**2).sqrt()).float()
        offset = (actions - self.null).flatten(1)
        offset = (self._terms(rods)[:, :, None] * offset[:, None]).flatten(1).double()
        gram = offset.T @ offset + 1e-3 * torch.eye(offset.shape[1])
        guess = torch.linalg.solve(gram, offset.T @ change.double()).float()
        self.guess = guess.view(self.guess.shape)

    def forward(self, state: Tensor, actions: Tensor, rods: Tensor) -> Tensor:
        """The change (B, 3 n) of states (B, 3 n) under actions (B, 2, 7), in network units, of rods
        with groups (B, 4)."""
        f = self.network
        state_units, action_units, prediction_units = self._units(rods)
        embedded = _modulated(f.state, (state - self.state_mean) @ self.whitening, state_units)
        null = self.null[:1].expand(len(state), 1, -1)
        left, right, still = _modulated(
            f.action,
            torch.cat([actions, null], 1),
            [(gain[:, None], shift[:, None]) for gain, shift in action_units],
        ).unbind(1)
        inputs = torch.stack(
            [torch.cat([embedded, left, right], 1), torch.cat([embedded, still, still], 1)]
        )
        moved, still = _modulated(f.prediction, inputs, prediction_units).unbind()
        offset = (actions - self.null).flatten(1)
        turned = (self._terms(rods)[:, :, None] * offset[:, None]).flatten(1)
        return turned @ self.guess.flatten(0, 1) + moved - still

    def export(self) -> tuple[Layers, Conditioning]:
        """For ``ShapePredictor``: weights with the whitening multiplied into the first layer."""
        state = _arrays(self.network.state)
        first, bias = state[0]
        folded = np.asarray(first @ _array(self.whitening.T), np.float32)
        state[0] = (folded, np.asarray(bias - folded @ _array(self.state_mean), np.float32))
        layers = Layers(
            state,
            _arrays(self.network.action),
            _arrays(self.network.prediction),
            _array(self.guess),
        )
        modulation = (_array(self.modulation.weight), _array(self.modulation.bias))
        return layers, Conditioning(
            _array(self.low), _array(self.high), _arrays(self.embedding), modulation
        )

    def _scaled(self, rods: Tensor) -> Tensor:
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low)
        return (rods.clamp(self.low, self.high) - middle) / half.clamp(min=1e-6)

    def _terms(self, rods: Tensor) -> Tensor:
        """``conditioning.guess_terms`` of groups (B, 4)."""
        inputs = self._scaled(rods)
        powers = inputs[:, :1] ** torch.arange(4)
        return torch.cat([powers, inputs[:, 1:]], 1)

    def _units(self, rods: Tensor) -> list[list[tuple[Tensor, Tensor]]]:
        """Gain and shift (B, units) of every layer, by block."""
        modulation = self.modulation(self.embedding(self._scaled(rods)))
        gains, shifts = (part.split(self.units, 1) for part in modulation.chunk(2, 1))
        layers = iter([(1.0 + gain, shift) for gain, shift in zip(gains, shifts, strict=True)])
        return [list(islice(layers, depth)) for depth in DEPTHS.values()]


def null_action() -> Tensor:
    """(2, 7): neither clamp moves."""
    null = torch.zeros(2, ACTION_SIZE)
    null[:, 3] = 1.0
    return null


def _modulated(block: nn.Sequential, value: Tensor, units: list[tuple[Tensor, Tensor]]) -> Tensor:
    """A block's output, each layer's units scaled and shifted before their activation."""
    rest = iter(units)
    for module in block:
        value = module(value)
        if isinstance(module, nn.Linear):
            gain, shift = next(rest)
            value = torch.addcmul(shift, gain, value)
    return value


def _layers(*sizes: int, activation: type[nn.Module]) -> nn.Sequential:
    parts: list[nn.Module] = []
    for i in range(len(sizes) - 1):
        parts += [nn.Linear(sizes[i], sizes[i + 1]), activation()]
    return nn.Sequential(*parts)


def _array(tensor: Tensor) -> Float32:
    return tensor.detach().float().contiguous().numpy().copy()


def _arrays(block: nn.Module) -> list[tuple[Float32, Float32]]:
    return [
        (_array(m.weight), _array(m.bias)) for m in block.children() if isinstance(m, nn.Linear)
    ]
