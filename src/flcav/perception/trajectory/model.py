"""A multi-modal LSTM encoder-decoder over tracks, with bird's-eye features from rasters or from several cameras.

Encoder: an LSTM over the past, and convolutions over rasters or a cross-view transformer. Decoder: one LSTM with a
different initial state per mode; at each step its inputs are position, last displacement and the ground's features at
the position, and its output is a change of the displacement. With zero output a path keeps heading and speed.

The cross-view transformer maps images of several cameras to features and a map of the ground (Zhou and Kraehenbuehl,
"Cross-view Transformers for Real-time Map-view Semantic Segmentation", CVPR 2022, sec. 3): places on the ground attend
to all places of all images at once, by cosine similarity (eq. 3); a place in an image is embedded by its features, the
position of the camera and the direction of its ray (eq. 2). In addition, each ray is intersected with a flat ground,
and attention is biased to near places by a Gaussian of the distance, whose width each head learns, after Chen et al.,
"Efficient and Robust 2D-to-BEV Representation Learning via Geometry-guided Kernel Transformer", 2022. Differences from
the paper: small convolutions instead of EfficientNet, one or two attention layers at one resolution, and ground around
the predicted road user instead of the vehicle with the cameras.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from flcav.perception.trajectory.config import FUTURE, STEP_S, CrossView, Patch, TrajectoryConfig
from flcav.perception.trajectory.rasters import LAYERS, OTHERS

COARSE = 8  # cells along each side of the pooled map
LEARNED = {"road": 1.0, "lane": 1.0, "crossing": 5.0, "way": 3.0, "red": 10.0, "green": 10.0, OTHERS[0]: 8.0}
"""Layers of the raster that cameras are taught to see, and how much more a cell in one weighs: some are rare."""
STRIDES = (4, 8)  # [px] of the image features, down and to the right; finer down, since the ground is foreshortened
FAR_M = 100.0  # largest distance of a ray's intersection with the ground, also of rays without one
SHARPNESS = 3.0  # initial inverse temperature of the cosine similarities; it is learned
NEAR = 3  # channels of query and key that hold the distance on the ground


class ForecastInputs(NamedTuple):
    """Input tensors of a batch of B samples: `raster`, or the last three of n cameras."""

    past: Tensor  # (B, PAST + 1, 4) x, y, yaw, speed [m, rad, m/s]
    raster: Tensor | None = None  # (B, LAYERS, cells, cells) of zeros and ones
    pictures: Tensor | None = None  # (B, n, 3, height, width) in [-1, 1]
    intrinsics: Tensor | None = None  # (B, n, 3, 3) [px]
    camera_from_frame: Tensor | None = None  # (B, n, 4, 4) from the road user's frame to the optical one


class GroundFeatures(NamedTuple):
    """Bird's-eye features of the surroundings."""

    summary: Tensor  # (B, summary) of the whole patch
    ground: Tensor  # (B, maps[1], h, w) of each place in the patch, row 0 farthest ahead and column 0 farthest left
    map_logits: Tensor | None = None  # (B, LEARNED, h, w) of the map's segmentation; None with rasters


class PatchPooling(nn.Module):
    """Pooling of the patch's feature maps to one vector, over a coarse grid so that places stay distinguishable."""

    def __init__(self, maps: int, out: int, size: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            conv(maps, out, 2), nn.AdaptiveMaxPool2d(COARSE), nn.Flatten(), nn.Linear(out * COARSE**2, size), nn.ReLU()
        )

    def forward(self, ground: Tensor) -> Tensor:
        """Return the vector (B, size) of feature maps (B, maps, h, w)."""
        return self.layers(ground)


class RasterEncoder(nn.Module):
    """Convolutional encoder of rasters of the map and the tracks."""

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        fine, ground, coarse = config.maps
        self.summary = 2 * config.hidden
        self.layers = nn.Sequential(conv(len(LAYERS), fine, 2), conv(fine, ground, 2))
        self.sum_up = PatchPooling(ground, coarse, self.summary)

    def forward(self, inputs: ForecastInputs) -> GroundFeatures:
        """Return the features of rasters (B, LAYERS, cells, cells); a place of `ground` is 4 x 4 cells."""
        assert inputs.raster is not None
        ground = self.layers(inputs.raster)
        return GroundFeatures(self.sum_up(ground), ground)


def conv(maps: int, out: int, stride: int | tuple[int, int] = 1) -> nn.Sequential:
    """Return a 3 x 3 convolution with group normalisation and ReLU."""
    return nn.Sequential(nn.Conv2d(maps, out, 3, stride, 1, bias=False), nn.GroupNorm(out // 8, out), nn.ReLU())


class CrossViewEncoder(nn.Module):
    """Cross-view transformer: images of several cameras to bird's-eye features, by attention."""

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        assert config.cameras is not None
        settings = config.cameras
        width = config.cameras.features
        self.summary = 2 * config.hidden
        self.pictures = nn.Sequential(conv(3, width // 2, 2), conv(width // 2, width, 2), conv(width, width, (1, 2)))
        self.direction = nn.Linear(3, width)
        self.standpoint = nn.Linear(3, width)
        self.place = nn.Linear(2, width)
        self.register_buffer("pixels", pixel_grid(settings), persistent=False)
        self.register_buffer("places", place_grid(settings, config.patch), persistent=False)
        self.ground = nn.Parameter(0.1 * torch.randn(settings.queries**2, width))
        self.rounds = nn.ModuleList(CrossAttention(width, settings.heads) for _ in range(settings.layers))
        self.refine = nn.Sequential(
            conv(width, width), nn.Upsample(scale_factor=2, mode="bilinear"), conv(width, config.maps[1])
        )
        self.map = nn.Conv2d(config.maps[1], len(LEARNED), 1)
        self.sum_up = PatchPooling(config.maps[1], config.maps[2], self.summary)

    pixels: Tensor  # (P, 3) homogeneous coordinates of the image features
    places: Tensor  # (Q, 2) x, y of the queries [SCALE_M]

    def forward(self, inputs: ForecastInputs) -> GroundFeatures:
        """Return the features of images (B, n, 3, height, width); `ground` has twice the resolution of the queries."""
        assert inputs.pictures is not None
        assert inputs.intrinsics is not None
        assert inputs.camera_from_frame is not None
        batch, cameras = inputs.pictures.shape[:2]
        features = self.pictures(inputs.pictures.flatten(0, 1)).flatten(2).transpose(1, 2)
        looks, stands = cast_rays(inputs.intrinsics, inputs.camera_from_frame, self.pixels)
        position = functional.normalize(self.direction(looks) - self.standpoint(stands)[:, :, None], dim=-1)
        seen = features.unflatten(0, (batch, cameras)) + position  # (B, n, P, width)
        seen, met = seen.flatten(1, 2), intersect_ground(looks, stands).flatten(1, 2)
        ground = (self.ground + self.place(self.places)).expand(batch, -1, -1)
        for attend in self.rounds:
            ground = attend(ground, self.places, seen, met)
        side = round(len(self.places) ** 0.5)
        maps = self.refine(ground.transpose(1, 2).unflatten(2, (side, side)))
        return GroundFeatures(self.sum_up(maps), maps, self.map(maps))


class CrossAttention(nn.Module):
    """A transformer layer: places on the ground attend to all places of all images at once, then an MLP."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key = (
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width - heads * NEAR)) for _ in "qk"
        )
        self.value = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width))
        self.out = nn.Linear(width, width)
        self.after = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )
        self.sharpness = nn.Parameter(torch.full((heads, 1, 1), SHARPNESS))
        self.nearness = nn.Parameter(torch.logspace(1, -1, heads)[:, None, None])  # the first head is the narrowest

    def forward(self, ground: Tensor, places: Tensor, seen: Tensor, met: Tensor) -> Tensor:
        """Return the ground's features (B, Q, width) after attention to the images' features `seen` (B, P, width).

        `places` (Q, 2) are the positions of the ground's features and `met` (B, P, 2) the rays' intersections with the
        ground [SCALE_M]. The softmax over P is of sharpness * cosine - nearness * |place - met|^2; the term |place|^2
        is omitted, since it cancels in the softmax.
        """
        query = self.sharpness * functional.normalize(self._split(self.query(ground)), dim=-1)
        key = functional.normalize(self._split(self.key(seen)), dim=-1)
        asks = self.nearness * functional.pad(2 * places, (0, 1), value=-1.0)  # (heads, Q, 3)
        lies = torch.cat((met, met.square().sum(dim=2, keepdim=True)), dim=2)[:, None]  # (B, 1, P, 3)
        query = torch.cat((query, asks.expand(len(query), -1, -1, -1)), dim=3)
        key = torch.cat((key, lies.expand(-1, self.heads, -1, -1)), dim=3)
        attended = functional.scaled_dot_product_attention(query, key, self._split(self.value(seen)), scale=1.0)
        ground = ground + self.out(attended.transpose(1, 2).flatten(2))
        return ground + self.after(ground)

    def _split(self, tokens: Tensor) -> Tensor:
        return tokens.unflatten(-1, (self.heads, -1)).transpose(1, 2)


def cast_rays(intrinsics: Tensor, camera_from_frame: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit directions (B, n, P, 3) of the rays through homogeneous `pixels` (P, 3), and their origins (B, n, 3).

    Both are in the frame of the road user; the origins, the cameras' positions, are in units of SCALE_M. `intrinsics`
    are (B, n, 3, 3) [px], `camera_from_frame` (B, n, 4, 4) [m].
    """
    frame_from_camera = camera_from_frame[..., :3, :3].transpose(-1, -2)
    back = frame_from_camera @ torch.linalg.inv(intrinsics)
    looks = functional.normalize(pixels @ back.transpose(-1, -2), dim=-1)
    stands = -(frame_from_camera @ camera_from_frame[..., :3, 3:])[..., 0]
    return looks, stands / SCALE_M


def intersect_ground(looks: Tensor, stands: Tensor) -> Tensor:
    """Return the intersections (B, n, P, 2) x, y of the rays with the ground z = 0 [SCALE_M], at most `FAR_M` away.

    `looks` and `stands` are the directions and origins of `cast_rays`.
    """
    level = torch.linalg.vector_norm(looks[..., :2], dim=-1, keepdim=True).clamp(min=1e-6)
    fall = (-looks[..., 2:] / level).clamp(min=1e-6)
    reach = (stands[:, :, None, 2:] / fall).clamp(max=FAR_M / SCALE_M)
    return stands[:, :, None, :2] + reach * looks[..., :2] / level


def pixel_grid(settings: CrossView) -> Tensor:
    """Return the homogeneous pixel coordinates (P, 3) of the centres of the image features, row by row."""
    down, right = (
        torch.arange(size // stride) * stride + (stride - 1) / 2
        for size, stride in zip((settings.height_px, settings.width_px), STRIDES)
    )
    v, u = torch.meshgrid(down, right, indexing="ij")
    return torch.stack((u, v, torch.ones_like(u)), dim=-1).reshape(-1, 3)


def place_grid(settings: CrossView, patch: Patch) -> Tensor:
    """Return the positions (Q, 2) x, y of the queries on the ground, row by row [SCALE_M]."""
    step = patch.side_m / settings.queries
    fore = patch.middle_x_m + patch.side_m / 2 - (torch.arange(settings.queries) + 0.5) * step
    left = patch.side_m / 2 - (torch.arange(settings.queries) + 0.5) * step
    return torch.stack(torch.meshgrid(fore, left, indexing="ij"), dim=-1).reshape(-1, 2) / SCALE_M


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
        hidden = config.hidden
        ground = config.maps[1]
        self.view = CrossViewEncoder(config) if config.cameras else RasterEncoder(config)
        self.track = nn.LSTM(TRACK, hidden, batch_first=True)
        self.context = nn.Sequential(nn.Linear(hidden + self.view.summary, 2 * hidden), nn.ReLU())
        self.begin = nn.Linear(2 * hidden, config.modes * hidden)
        self.likely = nn.Linear(2 * hidden, config.modes)
        self.decoder = nn.LSTMCell(4 + ground, hidden)
        self.change = nn.Linear(hidden, 2)
        nn.init.normal_(self.change.weight, std=0.01)
        nn.init.zeros_(self.change.bias)

    def forward(self, inputs: ForecastInputs) -> ForecastTensors:
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
        sampled = functional.grid_sample(ground, right_down[:, None], align_corners=False)
        return sampled[:, :, 0].transpose(1, 2)


def _features(past: Tensor) -> Tensor:
    x, y, yaw, speed = past.unbind(2)
    return torch.stack((x / SCALE_M, y / SCALE_M, yaw.cos(), yaw.sin(), speed / SCALE_M, speed.gt(0.1).float()), dim=2)
