"""L-Net: from a scan to the correction of its pose."""

from collections.abc import Sequence

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from models.scan_batch import Localisation, ScanBatch

# Convolution along the scan: DeepMapping's kernel and dilation (Ding & Feng, CVPR 2019).
KERNEL, DILATION = 3, 3
# DeepMapping's widths: encoder 64-128-1024, head 512-256.
PAPER_WIDTHS, PAPER_HEAD = (64, 128, 1024), (512, 256)


class LNet(Localisation):
    """Pose correction of each scan from its own points: rotation vector (radians), then translation.

    The last layer starts at zero, so the first correction is zero and training begins at the starting poses.

    Parameters
    ----------
    dimension: 2 or 3.
    encoder: ``"ordered"`` reads a scan in the order of its rays (convolutions along the scan; a masked point
        is a ray without a return); ``"unordered"`` (PointNet) reads a set. Both end in a maximum over the
        real points.
    widths: of the encoder. Default small, for seconds on a CPU.
    head: hidden widths of the fully connected head.
    scale: length, in the data's unit, by which points are divided first; about the range of a scan.

    Raises
    ------
    ValueError: an unknown encoder, a dimension other than 2 or 3, a width or scale that is not positive.
    """

    scale: Tensor

    def __init__(
        self,
        dimension: int,
        encoder: str = "unordered",
        *,
        widths: Sequence[int] = (32, 64, 128),
        head: Sequence[int] = (64,),
        scale: float = 1.0,
    ):
        super().__init__()
        if dimension not in (2, 3):
            raise ValueError(f"dimension is {dimension}; scans have 2 or 3 coordinates")
        if encoder not in ("ordered", "unordered"):
            raise ValueError(f"encoder is {encoder!r}; it must be 'ordered' or 'unordered'")
        if not widths or min(*widths, *head, 1) < 1:
            raise ValueError(
                f"widths {tuple(widths)} and head {tuple(head)} must be positive: try (32, 64, 128), (64,)"
            )
        if not scale > 0:
            raise ValueError(f"scale is {scale}; it is a length and must be positive: try the range of a scan")
        self.encoder = encoder
        kernel, dilation = (KERNEL, DILATION) if encoder == "ordered" else (1, 1)
        padding = dilation * (kernel // 2)
        channels = (dimension, *widths)
        self.layers = nn.ModuleList(
            nn.Conv1d(a, b, kernel, padding=padding, dilation=dilation)
            for a, b in zip(channels[:-1], channels[1:], strict=True)
        )
        self.head = _head((widths[-1], *head, dimension * (dimension + 1) // 2))
        self.register_buffer("scale", torch.tensor(float(scale)))

    @classmethod
    def paper(cls, dimension: int, scale: float = 1.0) -> "LNet":
        """DeepMapping's widths: the ordered encoder in 2D, a PointNet of the same widths in 3D."""
        encoder = "ordered" if dimension == 2 else "unordered"
        return cls(dimension, encoder, widths=PAPER_WIDTHS, head=PAPER_HEAD, scale=scale)

    def corrections(self, batch: ScanBatch) -> Float[Tensor, "g k"]:
        return self(batch.points, batch.mask)

    def forward(self, points: Float[Tensor, "g n d"], mask: Bool[Tensor, "g n"]) -> Float[Tensor, "g k"]:
        """Correction ``(g, k)``, k = 3 in 2D and 6 in 3D; an empty scan has one too."""
        real = mask[:, None, :]
        features = torch.where(real, points.mT / self.scale.to(points.dtype), 0.0)
        last = len(self.layers) - 1
        for number, layer in enumerate(self.layers):
            features = layer(features)
            # Zero where nothing was measured: the convolution sees padding as it sees the end of a scan.
            features = torch.where(real, features if number == last else features.relu(), 0.0)
        lowest = torch.finfo(features.dtype).min
        pooled = torch.where(real, features, lowest).amax(-1)
        return self.head(torch.where(mask.any(-1, keepdim=True), pooled, 0.0))


def _head(widths: Sequence[int]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for a, b in zip(widths[:-2], widths[1:-1], strict=True):
        layers += [nn.Linear(a, b), nn.ReLU()]
    last = nn.Linear(widths[-2], widths[-1])
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*layers, last)
