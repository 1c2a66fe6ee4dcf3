"""A run is a function that returns a complete configuration; the command line only overrides its fields."""

from dataclasses import asdict, dataclass

from lidarpose.errors import InputError


@dataclass(frozen=True, kw_only=True)
class Pretrain:
    """Pre-training on synthesized people, made while the network learns.

    size: of the network; scene: see `synth.scene`; people: how many are seen in all; batch: people a step; rate: peak
    learning rate of AdamW, the hidden matrices learn by Muon at `muon_rate`; easy: share of the run over which the
    difficulty rises from nothing to full; captured: share of poses from captured motion, where clips are given;
    motion: a file or folder of captured motion or none; subjects: those of its clips to learn from, none: all;
    workers: generator processes.
    """

    size: str = "tiny"
    scene: str = "wild"
    people: int = 300_000
    batch: int = 64
    rate: float = 2e-3
    muon_rate: float = 0.02
    easy: float = 0.15
    captured: float = 0.5
    motion: str | None = None
    subjects: tuple[str, ...] = ()
    seed: int = 0
    workers: int = 1

    def __post_init__(self):
        least = {"people": 1, "batch": 1, "rate": 0, "muon_rate": 0, "easy": 0, "captured": 0, "seed": 0, "workers": 0}
        for name, bound in least.items():
            if not getattr(self, name) >= bound:
                raise InputError(f"{name} must be at least {bound}, got {getattr(self, name)}")
        object.__setattr__(self, "subjects", tuple(self.subjects))

    def to_dict(self) -> dict:
        return asdict(self)


def default() -> Pretrain:
    """The recipe of the bundled weights but for its length."""
    return Pretrain()
