"""A multi-modal LSTM encoder-decoder over tracks with bird's-eye features of the surroundings.

Encoder: an LSTM over the past, and a bird's-eye view (`flcav.perception.trajectory.cross_view`). Decoder: one LSTM with
a different initial state per mode; at each step its inputs are position, last displacement and the ground's features at
the position, and its output is a change of the displacement. With zero output a path keeps heading and speed.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from flcav.perception.trajectory.config import FUTURE, STEP_S, TrajectoryConfig
from flcav.perception.trajectory.cross_view import CrossViewEncoder, GroundFeatures, Inputs, RasterEncoder

SCALE_M = 10.0  # unit of positions and speeds inside the network
TRACK = 6  # number of features of a point of the past


class ForecastTensors(NamedTuple):
    """Output tensors of the network: K modes per sample."""

    paths: Tensor  # (B, K, FUTURE, 2) x, y [m] in the frame of the present
    logits: Tensor  # (B, K) of the modes' probabilities
    map_logits: Tensor | None  # (B, LEARNED, h, w) of the map's segmentation; None with rasters


class TrajectoryNetwork(nn.Module):
    """The trajectory network: K paths of a road user with their probabilities."""

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        self.config = config
        hidden, ground = config.hidden, config.maps[1]
        self.view = CrossViewEncoder(config) if config.cameras else RasterEncoder(config)
        self.track = nn.LSTM(TRACK, hidden, batch_first=True)
        self.context = nn.Sequential(nn.Linear(hidden + self.view.summary, 2 * hidden), nn.ReLU())
        self.begin = nn.Linear(2 * hidden, config.modes * hidden)
        self.likely = nn.Linear(2 * hidden, config.modes)
        self.decoder = nn.LSTMCell(4 + ground, hidden)
        self.change = nn.Linear(hidden, 2)
        nn.init.normal_(self.change.weight, std=0.01)
        nn.init.zeros_(self.change.bias)

    def forward(self, inputs: Inputs) -> ForecastTensors:
        """Return the forecast of a batch."""
        seen = self.view(inputs)
        _, (encoded, _) = self.track(_features(inputs.past))
        context = self.context(torch.cat((encoded[-1], seen.summary), dim=1))
        paths = self._decoded(context, inputs.past[:, -1, 3] * STEP_S, seen)
        return ForecastTensors(paths, self.likely(context), seen.map_logits)

    def _decoded(self, context: Tensor, step_m: Tensor, seen: GroundFeatures) -> Tensor:
        batch, modes, hidden = len(context), self.config.modes, self.config.hidden
        state = torch.tanh(self.begin(context)).reshape(batch * modes, hidden)
        cell = torch.zeros_like(state)
        last = functional.pad(step_m[:, None, None], (0, 1)).expand(batch, modes, 2)
        position, path = torch.zeros_like(last), []
        for _ in range(FUTURE):
            here = self._ground_at(seen.ground, position)
            known = torch.cat((position / SCALE_M, last, here), dim=2)
            state, cell = self.decoder(known.reshape(batch * modes, -1), (state, cell))
            last = last + self.change(state).reshape(batch, modes, 2)
            position = position + last
            path.append(position)
        return torch.stack(path, dim=2)

    def _ground_at(self, ground: Tensor, position: Tensor) -> Tensor:
        """Return the features (B, K, features) of `ground` (B, features, h, w), bilinear, at positions (B, K, 2) [m].

        They are 0 outside the patch.
        """
        patch = self.config.patch
        half = patch.side_m / 2
        right_down = torch.stack((-position[..., 1] / half, (patch.middle_x_m - position[..., 0]) / half), dim=-1)
        found = functional.grid_sample(ground, right_down[:, None], align_corners=False)
        return found[:, :, 0].transpose(1, 2)


def _features(past: Tensor) -> Tensor:
    x, y, yaw, speed = past.unbind(2)
    return torch.stack((x / SCALE_M, y / SCALE_M, yaw.cos(), yaw.sin(), speed / SCALE_M, speed.gt(0.1).float()), dim=2)
