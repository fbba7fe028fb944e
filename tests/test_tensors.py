import pytest
import torch

from brewster.errors import ModelError
from brewster.models.diffusion.tensors import read_tensors, write_tensors


def test_tensors_and_metadata_survive_a_round_trip(tmp_path):
    tensors = {"b": torch.randn(2, 3).T, "a": torch.arange(3, dtype=torch.bfloat16), "empty": torch.zeros(0)}
    write_tensors(tmp_path / "t", tensors, {"name": "größer", "a": "1"})
    loaded, metadata = read_tensors(tmp_path / "t")
    assert metadata == {"format": "pt", "name": "größer", "a": "1"}
    assert all(torch.equal(loaded[name], tensor) for name, tensor in tensors.items())


@pytest.mark.parametrize("size", [0, 4, 40, -1])
def test_a_truncated_file_is_refused(tmp_path, size):
    write_tensors(tmp_path / "t", {"a": torch.zeros(9)}, {})
    whole = (tmp_path / "t").read_bytes()
    (tmp_path / "t").write_bytes(whole[:size])
    with pytest.raises(ModelError, match="cannot be read"):
        read_tensors(tmp_path / "t")
