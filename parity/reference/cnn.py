"""ResNet (He et al., CVPR 2016) and VGG-16 (Simonyan and Zisserman, ICLR 2015), as in torchvision.

Layers are numbered like a `torch.nn.Sequential` of torchvision's children, as in CosPlace's files.
"""

from torch import Tensor, nn
from torch.nn import functional as F

from crisalad_jax.nn.backbones.resnet import ResNetConfig
from parity.reference.layers import BatchNorm2d, Conv2d
from parity.reference.vit import Features

BLOCKS = {18: (2, 2, 2, 2), 50: (3, 4, 6, 3), 101: (3, 4, 23, 3), 152: (3, 8, 36, 3)}
VGG_16 = (64, 64, 0, 128, 128, 0, 256, 256, 256, 0, 512, 512, 512, 0, 512, 512, 512)
"""Widths of the 3 x 3 convolutions; 0 is a 2 x 2 max pooling."""


def _conv(d_in: int, d_out: int, side: int, stride: int = 1) -> Conv2d:
    return Conv2d(d_in, d_out, side, stride=stride, padding=side // 2, bias=False)


class Residual(nn.Module):
    """A block of two convolutions, or of three around a bottleneck."""

    def __init__(self, d_in: int, width: int, d_out: int, stride: int) -> None:
        """Make a block, with three convolutions if `d_out` differs from `width`."""
        super().__init__()
        deep = d_out != width
        self.conv1 = _conv(d_in, width, 1 if deep else 3, 1 if deep else stride)
        self.bn1 = BatchNorm2d(width)
        self.conv2 = _conv(width, width, 3, stride if deep else 1)
        self.bn2 = BatchNorm2d(width)
        if deep:
            self.conv3 = _conv(width, d_out, 1)
            self.bn3 = BatchNorm2d(d_out)
        self.downsample = (
            nn.Sequential(_conv(d_in, d_out, 1, stride), BatchNorm2d(d_out))
            if d_in != d_out
            else None
        )

    def forward(self, x: Tensor) -> Tensor:
        """Map (batch, d_in, rows, columns) to (batch, d_out, rows / stride, columns / stride)."""
        y = self.bn2(self.conv2(F.relu(self.bn1(self.conv1(x)))))
        if hasattr(self, "conv3"):
            y = self.bn3(self.conv3(F.relu(y)))
        return F.relu(y + (x if self.downsample is None else self.downsample(x)))


class ResNet(nn.Sequential):
    """The first convolution, max pooling, and the stages."""

    def __init__(self, config: ResNetConfig) -> None:
        """Make the stages that the configuration uses."""
        stages, d_in = [], 64
        for stage, count in enumerate(BLOCKS[config.layers][: config.stages]):
            width = 64 * 2**stage
            d_out = width if config.layers == 18 else 4 * width
            blocks = []
            for i in range(count):
                blocks.append(Residual(d_in, width, d_out, 2 if stage and not i else 1))
                d_in = d_out
            stages.append(nn.Sequential(*blocks))
        first = _conv(3, 64, 7, 2), BatchNorm2d(64), nn.ReLU(), nn.MaxPool2d(3, 2, 1)
        super().__init__(*first, *stages)

    def forward(self, images: Tensor) -> Features:
        """Map (batch, 3, height, width) to the last stage's feature map; no class token."""
        return Features(images.new_zeros(len(images), 0), super().forward(images))


class Vgg(nn.Sequential):
    """VGG-16's convolutions; the last has no ReLU."""

    def __init__(self) -> None:
        """Make the thirteen convolutions."""
        layers: list[nn.Module] = []
        d_in = 3
        for width in VGG_16:
            if width:
                layers += [Conv2d(d_in, width, 3, padding=1), nn.ReLU()]
                d_in = width
            else:
                layers.append(nn.MaxPool2d(2))
        super().__init__(*layers[:-1])

    def forward(self, images: Tensor) -> Features:
        """Map (batch, 3, height, width) to the last convolution's feature map; no class token."""
        return Features(images.new_zeros(len(images), 0), super().forward(images))
