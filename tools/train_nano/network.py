"""prism-nano: inverted residuals down to a 32nd of the picture, a light decoder back to half of it.

Three answers from one pass: depth (focal-normalised: metres = depth * f / ruler.CANONICAL_FOCAL), confidence
of each depth, and a descriptor of the place. Widths are MobileNet-like; everything is convolution, batch
normalisation and ReLU, which any runtime does fast.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional as F  # noqa: N812

DESCRIPTOR = 256
_PLACE_WIDTH = 192  # of the maps that a descriptor is pooled from
_PLACES_PULL = 0.05
_LEAST_ERROR, _LARGEST_ERROR = 0.005, 1.0  # bounds of the predicted mean error of log depth


def convolution(inside: int, outside: int, size: int = 1, stride: int = 1, groups: int = 1) -> nn.Sequential:
    """Convolution, batch normalisation, ReLU."""
    return nn.Sequential(
        nn.Conv2d(inside, outside, size, stride, size // 2, groups=groups, bias=False),
        nn.BatchNorm2d(outside),
        nn.ReLU(inplace=True),
    )


class Inverted(nn.Module):
    """Inverted residual: widen, filter each channel, narrow without a nonlinearity; added to its input."""

    def __init__(self, inside: int, outside: int, stride: int, widen: int) -> None:
        super().__init__()
        middle = inside * widen
        self.body = nn.Sequential(
            convolution(inside, middle),
            convolution(middle, middle, 3, stride, middle),
            nn.Conv2d(middle, outside, 1, bias=False),
            nn.BatchNorm2d(outside),
        )
        self.is_residual = stride == 1 and inside == outside

    def forward(self, x: Tensor) -> Tensor:
        y: Tensor = self.body(x)
        return x + y if self.is_residual else y


class Merge(nn.Module):
    """Doubles a coarse map and adds a fine one, each brought to one width; filters what comes out."""

    def __init__(self, coarse: int, fine: int, width: int) -> None:
        super().__init__()
        self.coarse = nn.Sequential(nn.Conv2d(coarse, width, 1, bias=False), nn.BatchNorm2d(width))
        self.fine = nn.Sequential(nn.Conv2d(fine, width, 1, bias=False), nn.BatchNorm2d(width))
        self.filter = nn.Sequential(convolution(width, width, 3, 1, width), convolution(width, width))

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        up = F.interpolate(self.coarse(coarse), size=fine.shape[2:], mode="bilinear", align_corners=False)
        y: Tensor = self.filter(F.relu(up + self.fine(fine)))
        return y


class Context(nn.Module):
    """Adds to every pixel what the whole picture says: a room's size shows nowhere in particular."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.body = nn.Sequential(nn.Linear(width, width), nn.ReLU(inplace=True), nn.Linear(width, width))

    def forward(self, x: Tensor) -> Tensor:
        whole: Tensor = self.body(x.mean(dim=(2, 3)))
        return x + whole[:, :, None, None]


class Place(nn.Module):
    """Descriptor (n, DESCRIPTOR) of unit length from maps of features, fine to coarse: see :meth:`gather`."""

    def __init__(self, *widths: int) -> None:
        super().__init__()
        # Each kind of feature has its own scale: one normalisation before they are mixed.
        self.level = nn.BatchNorm2d(sum(widths), affine=False)
        self.mix = nn.Sequential(
            convolution(sum(widths), _PLACE_WIDTH),
            convolution(_PLACE_WIDTH, _PLACE_WIDTH, 3, 1, _PLACE_WIDTH),
            convolution(_PLACE_WIDTH, _PLACE_WIDTH),
        )
        # Without its mean over pictures: what all have in common tells no place from another.
        self.centre = nn.BatchNorm1d(5 * _PLACE_WIDTH, affine=False)
        self.turn = nn.Linear(5 * _PLACE_WIDTH, DESCRIPTOR, bias=False)

    def gather(self, maps: Sequence[Tensor]) -> Tensor:
        """Maps (n, c, h, w), each of twice or once the next one's size, as one of the last one's size."""
        pooled = []
        for x in maps:
            if self.training:  # depth comes first: places pull at what both share with little force
                x = x.detach() + _PLACES_PULL * (x - x.detach())
            times = x.shape[2] // maps[-1].shape[2]
            pooled.append(F.avg_pool2d(x, times) if times > 1 else x)
        return torch.cat(pooled, dim=1)

    def forward(self, gathered: Tensor) -> Tensor:
        x = self.mix(self.level(gathered))
        # Where in a picture something is tells as much of a place as that it is there at all.
        quarters = F.adaptive_avg_pool2d(x, 2).flatten(1)
        y: Tensor = self.turn(self.centre(torch.cat([quarters, x.amax(dim=(2, 3))], dim=1)))
        return y / (y.square().sum(dim=1, keepdim=True) + 1e-12).sqrt()


class Nano(nn.Module):
    """Input (n, 3, h, w), h and w multiples of 16; see :meth:`forward`."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = convolution(3, 16, 3, 2)
        self.quarter = nn.Sequential(convolution(16, 24, 3, 2), Inverted(24, 24, 1, 3))
        self.eighth = nn.Sequential(Inverted(24, 40, 2, 4), Inverted(40, 40, 1, 4))
        self.sixteenth = nn.Sequential(
            Inverted(40, 80, 2, 4), *(Inverted(80, 80, 1, 4) for _ in range(2)), Inverted(80, 96, 1, 4)
        )
        self.coarsest = nn.Sequential(
            Inverted(96, 160, 2, 4), Inverted(160, 160, 1, 4), Inverted(160, 160, 1, 4), Context(160)
        )
        self.merge16 = Merge(160, 96, 80)
        self.merge8 = Merge(80, 40, 48)
        self.merge4 = Merge(48, 24, 24)
        self.head = nn.Sequential(convolution(24, 24, 3), nn.Conv2d(24, 8, 1))
        with torch.no_grad():  # begin at 2.5 m and 20 %
            self.head[-1].bias.copy_(torch.tensor([0.9] * 4 + [-1.6] * 4))
        self.place = Place(24, 40, 96, 80)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Log depth (n, 1, h/2, w/2), log of its expected error likewise, descriptor (n, DESCRIPTOR).

        The error is the mean absolute one of log depth, that is about the relative error of depth.
        """
        fine, maps = self._maps(image)
        both = F.pixel_shuffle(self.head(self.merge4(fine, maps[0])), 2)
        error = both[:, 1:].clamp(_LOG_LEAST, _LOG_LARGEST)
        return both[:, :1], error, self.place(self.place.gather(maps))

    def place_maps(self, image: Tensor) -> Tensor:
        """What the descriptor is made of (n, c, h/16, w/16): :class:`Place` takes it from there."""
        return self.place.gather(self._maps(image)[1])

    def _maps(self, image: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        """The decoder's map at an 8th; and maps at a quarter, an 8th, a 16th, and the decoder's at a 16th."""
        quarter = self.quarter(self.stem(image))
        eighth = self.eighth(quarter)
        sixteenth = self.sixteenth(eighth)
        merged = self.merge16(self.coarsest(sixteenth), sixteenth)
        return self.merge8(merged, eighth), (quarter, eighth, sixteenth, merged)


class Exported(nn.Module):
    """What the file computes: depth, confidence = 1 / expected relative error, descriptor."""

    def __init__(self, nano: Nano) -> None:
        super().__init__()
        self.nano = nano

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        depth, error, descriptor = self.nano(image)
        return depth.exp(), (-error).exp(), descriptor


_LOG_LEAST, _LOG_LARGEST = (float(torch.log(torch.tensor(e))) for e in (_LEAST_ERROR, _LARGEST_ERROR))
