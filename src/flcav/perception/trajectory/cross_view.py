"""A cross-view transformer: pictures of several cameras to features and a map of the ground.

Zhou and Kraehenbuehl, "Cross-view Transformers for Real-time Map-view Semantic Segmentation", CVPR 2022, sec. 3. Each
place in a picture is known by the direction in which its camera looks there (eq. 2), each place on the ground by where
it is, both relative to where the camera stands; the ground attends to the pictures by the cosine of the two (eq. 3).
Small convolutions take the place of the paper's EfficientNet, there are one or two rounds of attention to one
resolution, and the ground lies around the road user that is predicted instead of the vehicle with the cameras.
"""

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn
from torch.nn import functional

from flcav.perception.trajectory.config import CrossView, Patch, TrajectoryConfig
from flcav.perception.trajectory.rasters import OTHERS, STATIC
from flcav.perception.trajectory.views import Seen, Summary, conv

if TYPE_CHECKING:
    from flcav.perception.trajectory.model import Inputs

LEARNED = (*STATIC, OTHERS[0])  # layers of the raster that cameras are taught to see
STRIDE = 8  # pixels of a picture to a place of its features
SHARPNESS = 10.0  # the first inverse temperature of the attention; it is learned


class CrossViewEncoder(nn.Module):
    """Pictures to what is seen of the ground, by attention."""

    def __init__(self, config: TrajectoryConfig) -> None:
        super().__init__()
        assert config.cameras is not None
        settings, width = config.cameras, config.cameras.features
        self.summary = 2 * config.hidden
        self.pictures = nn.Sequential(conv(3, width // 2, 2), conv(width // 2, width, 2), conv(width, width, 2))
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
        self.sum_up = Summary(config.maps[1], config.maps[2], self.summary)

    pixels: Tensor  # (P, 3) homogeneous
    places: Tensor  # (Q, 2) x, y [patch sides]

    def forward(self, inputs: "Inputs") -> Seen:
        """Return what is seen in (B, n, 3, height, width) pictures; places are half as far apart as the queries."""
        assert inputs.pictures is not None
        assert inputs.intrinsics is not None
        assert inputs.camera_from_frame is not None
        batch, cameras = inputs.pictures.shape[:2]
        features = self.pictures(inputs.pictures.flatten(0, 1)).flatten(2).transpose(1, 2)
        features = features.unflatten(0, (batch, cameras))  # (B, n, P, width)
        looks, stands = rays(inputs.intrinsics, inputs.camera_from_frame, self.pixels)
        standpoint = self.standpoint(stands)[:, :, None]  # (B, n, 1, width)
        key = features + functional.normalize(self.direction(looks) - standpoint, dim=-1)
        where = functional.normalize(self.place(self.places)[None, None] - standpoint, dim=-1)  # (B, n, Q, width)
        ground = self.ground.expand(batch, -1, -1)
        for attend in self.rounds:
            ground = attend(ground, where, key, features)
        side = round(len(self.places) ** 0.5)
        maps = self.refine(ground.transpose(1, 2).unflatten(2, (side, side)))
        return Seen(self.sum_up(maps), maps, self.map(maps))


class CrossAttention(nn.Module):
    """The ground attends to the places of all pictures at once (eq. 3), then a perceptron."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.query, self.key, self.value = (nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width)) for _ in "qkv")
        self.out = nn.Linear(width, width)
        self.after = nn.Sequential(
            nn.LayerNorm(width), nn.Linear(width, 2 * width), nn.GELU(), nn.Linear(2 * width, width)
        )
        self.sharpness = nn.Parameter(torch.full((heads, 1, 1), SHARPNESS))

    def forward(self, ground: Tensor, where: Tensor, key: Tensor, features: Tensor) -> Tensor:
        """Return the ground (B, Q, width) after a look at n pictures.

        `where` (B, n, Q, width) is its position relative to each camera, `key` and `features` are (B, n, P, width).
        """
        query = functional.normalize(self._split(self.query(ground[:, None] + where)), dim=-1)
        keys = functional.normalize(self._split(self.key(key)), dim=-1)
        alike = self.sharpness * (query @ keys.transpose(-1, -2))  # (B, n, heads, Q, P)
        share = alike.permute(0, 2, 3, 1, 4).flatten(3).softmax(dim=-1)  # over the places of all pictures
        value = self._split(self.value(features)).transpose(1, 2).flatten(2, 3)  # (B, heads, n P, width / heads)
        found = (share @ value).transpose(1, 2).flatten(2)
        ground = ground + self.out(found)
        return ground + self.after(ground)

    def _split(self, tokens: Tensor) -> Tensor:
        return tokens.unflatten(-1, (self.heads, -1)).transpose(2, 3)


def rays(intrinsics: Tensor, camera_from_frame: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit directions (B, n, P, 3) of the homogeneous `pixels` (P, 3), and where the cameras stand (B, n, 3).

    Both are in the frame of the road user; the standpoint is divided by 10 m.
    """
    frame_from_camera = camera_from_frame[..., :3, :3].transpose(-1, -2)
    back = frame_from_camera @ torch.linalg.inv(intrinsics)
    looks = functional.normalize(pixels @ back.transpose(-1, -2), dim=-1)
    stands = -(frame_from_camera @ camera_from_frame[..., :3, 3:])[..., 0]
    return looks, stands / 10.0


def pixel_grid(settings: CrossView) -> Tensor:
    """Return (P, 3) the homogeneous middles of the features' places in a picture, row by row [px]."""
    down = torch.arange(settings.height_px // STRIDE) * STRIDE + (STRIDE - 1) / 2
    right = torch.arange(settings.width_px // STRIDE) * STRIDE + (STRIDE - 1) / 2
    v, u = torch.meshgrid(down, right, indexing="ij")
    return torch.stack((u, v, torch.ones_like(u)), dim=-1).reshape(-1, 3)


def place_grid(settings: CrossView, patch: Patch) -> Tensor:
    """Return (Q, 2) x, y of the places on the ground that ask, row by row, divided by 10 m."""
    step = patch.side_m / settings.queries
    fore = patch.middle_x_m + patch.side_m / 2 - (torch.arange(settings.queries) + 0.5) * step
    left = patch.side_m / 2 - (torch.arange(settings.queries) + 0.5) * step
    return torch.stack(torch.meshgrid(fore, left, indexing="ij"), dim=-1).reshape(-1, 2) / 10.0
