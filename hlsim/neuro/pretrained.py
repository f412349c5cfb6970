"""Loading of trained networks that emulate MSBG."""

from pathlib import Path

from hlsim.calibration import PASCAL_SPL
from hlsim.neuro.config import NEURO_RATE, NeuroConfig
from hlsim.neuro.model import NeuroMSBG
from hlsim.pretrained import SIMULATOR, read_checkpoint


def load_pretrained(
    name: str | Path, *, sample_rate: int = NEURO_RATE, full_scale_spl: float = PASCAL_SPL
) -> NeuroMSBG:
    """Load a trained Neuro-MSBG, frozen and in eval mode, without downloads.

    Args:
        name: Name of a checkpoint that ships with hlsim, such as ``"neuro-msbg"``, or a checkpoint
            folder.
        sample_rate: Sample rate of inputs and outputs in Hz, 16000 to 48000.
        full_scale_spl: Level in dB SPL of RMS 1.0.

    Raises:
        ValueError: There is no such checkpoint, it is damaged, or it is no simulator.

    >>> import torch
    >>> load_pretrained("neuro-msbg-light")(torch.randn(2, 16000), "N3").shape
    torch.Size([2, 16000])
    """

    def build(config: NeuroConfig) -> NeuroMSBG:
        return NeuroMSBG(
            config, sample_rate=sample_rate, full_scale_spl=full_scale_spl, compute_prior=False
        )

    model = read_checkpoint(name, {SIMULATOR: NeuroConfig.from_dict}, build)
    return model.eval().requires_grad_(False)
