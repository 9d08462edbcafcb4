"""Random draws of a sample, each keyed by (seed, step, sample key, purpose) and by nothing else.

No state is carried from draw to draw: the number of processes, the order of samples and a resume change nothing, and a
new kind of draw disturbs no other.
"""

import hashlib

import torch


def keyed_seed(*parts: object) -> int:
    """63 bits from the parts."""
    text = "\x1f".join(str(part) for part in parts)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:8], "big") >> 1


def keyed_uniform(*parts: object) -> float:
    """A number in [0, 1)."""
    # 53 bits: what a float holds exactly.
    return (keyed_seed(*parts) >> 10) / 2**53


def keyed_normal(shape: tuple[int, ...], *parts: object) -> torch.Tensor:
    """Standard normal float32, drawn on the CPU so that every device sees the same numbers."""
    generator = torch.Generator().manual_seed(keyed_seed(*parts))
    return torch.randn(shape, generator=generator)
