"""The paper's network (Section IV-B1, Fig. 3), and the form of it that is shipped."""

import numpy as np
import torch
from torch import Tensor, nn

from dlo_gym.surrogate.weights_file import ACTION_SIZE, Float32, Layers

HIDDEN = 256
NOISE_FLOOR = 0.02  # of the whitening, in units of the network's input


class DloNetwork(nn.Module):
    """State block, action block shared by both clamps, prediction block; ReLU between layers.

    Args:
        n_nodes: of the rod.
        hidden: width of the state and prediction blocks, twice that of the action block.
    """

    def __init__(self, n_nodes: int, hidden: int = HIDDEN) -> None:
        super().__init__()
        size, half = 3 * n_nodes, hidden // 2
        self.state = _layers(size, hidden, hidden, hidden)
        self.action = _layers(ACTION_SIZE, half, half)
        self.prediction = _layers(2 * hidden, hidden, hidden, hidden, size)[:-1]

    def forward(self, state: Tensor, actions: Tensor) -> Tensor:
        """The change (B, 3 n) of states (B, 3 n) under actions (B, 2, 7), in network units."""
        return self.prediction(torch.cat([self.state(state), self.action(actions).flatten(1)], 1))


class RelativeNetwork(nn.Module):
    """The paper's network between a whitened input and a linear first guess.

    The predicted change is ``guess(A) + f(S, A) - f(S, 0)``: nothing moves unless a clamp does.
    The state enters ``f`` in whitened principal components, because the bends that matter are
    small beside the rod's extent; exported weights contain the whitening.
    """

    state_mean: Tensor
    whitening: Tensor
    guess: Tensor
    null: Tensor

    def __init__(self, n_nodes: int, hidden: int = HIDDEN) -> None:
        super().__init__()
        size = 3 * n_nodes
        self.network = DloNetwork(n_nodes, hidden)
        self.register_buffer("state_mean", torch.zeros(size))
        self.register_buffer("whitening", torch.eye(size))
        self.register_buffer("guess", torch.zeros(2 * ACTION_SIZE, size))
        self.register_buffer("null", null_action()[None], persistent=False)

    def fit(self, state: Tensor, actions: Tensor, change: Tensor) -> None:
        """Whitening and first guess from samples (B, 3 n), (B, 2, 7), (B, 3 n)."""
        self.state_mean = state.mean(0)
        variances, components = torch.linalg.eigh(torch.cov(state.T.double()))
        self.whitening = (components / (variances + NOISE_FLOOR**2).sqrt()).float()
        offset = (actions - self.null).flatten(1).double()
        gram = offset.T @ offset + 1e-3 * torch.eye(offset.shape[1])
        self.guess = torch.linalg.solve(gram, offset.T @ change.double()).float()

    def forward(self, state: Tensor, actions: Tensor) -> Tensor:
        """The change (B, 3 n) of states (B, 3 n) under actions (B, 2, 7), in network units."""
        f = self.network
        embedded = f.state((state - self.state_mean) @ self.whitening)
        moved = torch.cat([embedded, f.action(actions).flatten(1)], 1)
        null = f.action(self.null).flatten(1).expand(len(state), -1)
        moved, still = f.prediction(torch.cat([moved, torch.cat([embedded, null], 1)])).chunk(2)
        return (actions - self.null).flatten(1) @ self.guess + moved - still

    def export(self) -> Layers:
        """For ``ShapePredictor``: weights with the whitening multiplied into the first layer."""
        state = _arrays(self.network.state)
        first, bias = state[0]
        folded = np.asarray(first @ _array(self.whitening.T), np.float32)
        state[0] = (folded, np.asarray(bias - folded @ _array(self.state_mean), np.float32))
        return Layers(
            state,
            _arrays(self.network.action),
            _arrays(self.network.prediction),
            _array(self.guess),
        )


def null_action() -> Tensor:
    """(2, 7): neither clamp moves."""
    null = torch.zeros(2, ACTION_SIZE)
    null[:, 3] = 1.0
    return null


def _layers(*sizes: int) -> nn.Sequential:
    parts: list[nn.Module] = []
    for i in range(len(sizes) - 1):
        parts += [nn.Linear(sizes[i], sizes[i + 1]), nn.ReLU()]
    return nn.Sequential(*parts)


def _array(tensor: Tensor) -> Float32:
    return tensor.detach().float().contiguous().numpy().copy()


def _arrays(block: nn.Module) -> list[tuple[Float32, Float32]]:
    return [
        (_array(m.weight), _array(m.bias)) for m in block.children() if isinstance(m, nn.Linear)
    ]
