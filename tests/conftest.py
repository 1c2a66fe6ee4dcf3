"""Settings and fixtures of all tests. Hypothesis has no deadline, because a busy machine would exceed it."""

import pytest
from hypothesis import settings

settings.register_profile("untimed", settings(deadline=None))
settings.load_profile("untimed")


@pytest.fixture(scope="session")
def smpl(tmp_path_factory):
    """A small body in SMPL's file format."""
    from dataset_files import write_smpl

    return write_smpl(tmp_path_factory.mktemp("smpl") / "SMPL_NEUTRAL.npz")


@pytest.fixture(scope="module")
def one_thread():
    """One thread for torch, so that sums do not depend on the machine."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
