"""Train an aid with Lightning in bfloat16.

The loss computes in float32 by itself, and is not part of the checkpoint.
"""

import lightning
import torch
from torch import Tensor, nn
from torch.utils.data import DataLoader, TensorDataset

from hlsim import Audiogram, HearingLossLoss
from hlsim.calibration import set_level


class Aid(lightning.LightningModule):
    def __init__(self, ear: str = "N3") -> None:
        super().__init__()
        self.network = nn.Conv1d(1, 1, 65, padding=32)
        self.loss = HearingLossLoss(Audiogram.standard(ear))

    def training_step(self, batch: list[Tensor], index: int) -> Tensor:
        speech = batch[0]  # (items, 1, time)
        value: Tensor = self.loss(self.network(speech), speech)
        self.log("loss", value)
        return value

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam(self.parameters(), lr=1e-3)


def main(steps: int = 20) -> Aid:
    speech = set_level(torch.randn(8, 1, 8000), 65.0)
    trainer = lightning.Trainer(
        max_steps=steps,
        precision="bf16-mixed",
        accelerator="auto",
        devices=1,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    aid = Aid()
    trainer.fit(aid, DataLoader(TensorDataset(speech), batch_size=4))
    return aid


if __name__ == "__main__":
    main()
