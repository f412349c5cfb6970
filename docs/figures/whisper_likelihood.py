"""Whisper in torch, with a gradient for the sound, from a model for CTranslate2.

A text is likely where Whisper finds its words in the sound. train_by_recogniser.py trains a hearing
aid by this likelihood. The model is a file `model.bin` in float16 or float32.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

HEAD_WIDTH = 64  # width of an attention head in all models of Whisper
FLOAT_TYPES = {0: np.float32, 4: np.float16}  # types by their number in the file


def read_weights(path: str | Path, device: str = "cpu") -> dict[str, Tensor]:
    """Read the weights of a model for CTranslate2, by names such as ``encoder/conv1/weight``.

    They become float32. Numbers of other types than float16 and float32 are left out.
    """
    weights = {}
    with open(path, "rb") as file:

        def read_number(code: str) -> int:
            (number,) = struct.unpack(f"<{code}", file.read(struct.calcsize(code)))
            return int(number)

        def read_text() -> str:
            return file.read(read_number("H"))[:-1].decode()

        read_number("I")  # version of the format
        read_text()  # name of the kind of model
        read_number("I")  # version of this kind
        for _ in range(read_number("I")):
            name = read_text()
            shape = [read_number("I") for _ in range(read_number("B"))]
            kind, size = read_number("B"), read_number("I")
            content = file.read(size)
            if kind in FLOAT_TYPES:
                values = np.frombuffer(content, FLOAT_TYPES[kind]).reshape(shape)
                weights[name] = torch.tensor(values, dtype=torch.float32, device=device)
    return weights


class TextLikelihood:
    """Whisper in torch: the likelihood of texts, with a gradient for the waveform.

    Args:
        weights: Weights from ``read_weights``.
        mel_filters: Weights of 201 frequencies in mel bands, on the same device: (bands, 201).
        prompt: Tokens before each text.
    """

    def __init__(
        self, weights: Mapping[str, Tensor], mel_filters: Tensor, prompt: Sequence[int]
    ) -> None:
        self.weights = weights
        self.mel_filters = mel_filters
        self.device = mel_filters.device
        self.prompt = torch.tensor(prompt, device=self.device)

    def __call__(self, waveform: Tensor, tokens: Tensor) -> Tensor:
        """Return the log likelihood of each token, given the sound and the tokens before it.

        Args:
            waveform: Sounds at 16 kHz with a peak of 0.5. Shape: (items, time).
            tokens: Texts; padding, whose result has no meaning, is -1. Shape: (items, tokens).

        Returns:
            Natural logarithms. Shape: (items, tokens).
        """
        sound = self._encode(waveform)
        tokens = tokens.clamp_min(0)
        embedding = self.weights["decoder/embeddings/weight"]
        inputs = torch.cat((self.prompt.expand(len(tokens), -1), tokens), 1)
        x = self._apply_layers("decoder", embedding[inputs], sound)
        # The last token of the prompt predicts the first token of the text.
        logits = x[:, len(self.prompt) - 1 : -1] @ embedding.T
        # cross_entropy(logits.mT, tokens) is less accurate: 1e-4 with Whisper's 51,864 tokens.
        return logits.log_softmax(-1).gather(-1, tokens.unsqueeze(-1)).squeeze(-1)

    def _encode(self, waveform: Tensor) -> Tensor:
        """Return the encoder's output. Shape: (items, time) -> (items, frames, width)."""
        window = torch.hann_window(400, device=waveform.device)
        spectrum = torch.stft(waveform, 400, 160, window=window, return_complex=True)
        power = spectrum[..., :-1].abs().square()
        log_power = (self.mel_filters @ power).clamp_min(1e-10).log10()
        floor = log_power.detach().amax((-2, -1), keepdim=True) - 8.0
        x = (torch.maximum(log_power, floor) + 4.0) / 4.0
        for name, stride in (("encoder/conv1", 1), ("encoder/conv2", 2)):
            weight, bias = self.weights[f"{name}/weight"], self.weights[f"{name}/bias"]
            x = functional.gelu(functional.conv1d(x, weight, bias, stride, padding=1))
        return self._apply_layers("encoder", x.mT)

    def _apply_layers(self, half: str, x: Tensor, sound: Tensor | None = None) -> Tensor:
        """Apply the layers of the encoder, or those of the decoder, which attend to the sound.

        Shape: (items, positions, width) -> (items, positions, width).
        """
        x = x + self.weights[f"{half}/position_encodings/encodings"][: x.shape[1]]
        layer = 0
        while f"{half}/layer_{layer}/ffn/linear_0/weight" in self.weights:
            name = f"{half}/layer_{layer}/self_attention"
            signals = self._linear(f"{name}/linear_0", self._normalise(name, x)).chunk(3, -1)
            attended = _attend(*signals, is_causal=sound is not None)
            x = x + self._linear(f"{name}/linear_1", attended)
            if sound is not None:
                name = f"{half}/layer_{layer}/attention"
                queries = self._linear(f"{name}/linear_0", self._normalise(name, x))
                keys, values = self._linear(f"{name}/linear_1", sound).chunk(2, -1)
                x = x + self._linear(f"{name}/linear_2", _attend(queries, keys, values))
            name = f"{half}/layer_{layer}/ffn"
            inner = self._linear(f"{name}/linear_0", self._normalise(name, x))
            x = x + self._linear(f"{name}/linear_1", functional.gelu(inner))
            layer += 1
        return self._normalise(half, x)

    def _normalise(self, name: str, x: Tensor) -> Tensor:
        gamma, beta = (self.weights[f"{name}/layer_norm/{part}"] for part in ("gamma", "beta"))
        return functional.layer_norm(x, x.shape[-1:], gamma, beta)

    def _linear(self, name: str, x: Tensor) -> Tensor:
        weight, bias = self.weights[f"{name}/weight"], self.weights.get(f"{name}/bias")
        return functional.linear(x, weight, bias)


def _attend(queries: Tensor, keys: Tensor, values: Tensor, is_causal: bool = False) -> Tensor:
    """Return the attention of all heads. Shape: (items, positions, width) each."""
    heads = (x.unflatten(-1, (-1, HEAD_WIDTH)).transpose(1, 2) for x in (queries, keys, values))
    attended = functional.scaled_dot_product_attention(*heads, is_causal=is_causal)
    return attended.transpose(1, 2).flatten(2)
