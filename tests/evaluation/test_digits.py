"""Digits, noises, listener and thresholds of the digits-in-noise test."""

import threading
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from scipy.special import expit, logit

import hlsim
from compensators import NALR
from hlsim import Listener, reception_threshold
from hlsim.calibration import set_level
from hlsim.checkpoint import checkpoints_folder
from hlsim.cli.main import main
from hlsim.data.bundled import DIGITS
from hlsim.evaluation.digits import DigitTest, ReceptionThreshold
from hlsim.evaluation.digits.material import (
    Triplets,
    draw_triplets,
    load_digits,
    perceive,
    present,
)
from hlsim.evaluation.digits.people import people_threshold
from hlsim.evaluation.digits.psychometric import TARGET, Estimate, estimate_threshold, subtract
from hlsim.evaluation.digits.recogniser import (
    DigitListener,
    DigitListenerConfig,
    load_listener,
)
from hlsim.simulators import Attenuation, load_simulator
from tests.helpers import load_figure

QUICK: dict[str, Any] = {"simulator": "attenuation", "triplets": 30}
"""Settings of a test of a second."""


def draw(count: int, seed: int = 0) -> Triplets:
    return draw_triplets(count, torch.Generator().manual_seed(seed))


def share_right(ear: object, snr: float, noise_spl: float = 65.0, simulator: str = "msbg") -> float:
    """Return the share of the digits of 16 triplets that the listener recognises."""
    triplets = draw(16)
    signals = present(triplets, torch.full((16,), snr), noise_spl)
    thresholds = torch.tensor(hlsim.audiogram.as_audiogram(ear).thresholds)
    perceived = perceive(signals, thresholds, load_simulator(simulator), triplets.internal)
    recognised = load_listener()(perceived).argmax(-1)
    return float((recognised == triplets.digits).float().mean())


def test_digits_are_small_and_have_one_level() -> None:
    bank = load_digits()
    assert bank.shape == (8, 10, 12000)
    assert sum(path.stat().st_size for path in DIGITS.iterdir()) < 1_000_000
    speech = bank[..., 800:]  # without the silence before it
    for word in speech.flatten(0, 1):
        end = int(word.nonzero().max()) + 1 - 800
        assert float(word[:end].square().mean().sqrt()) == pytest.approx(1.0, abs=0.1)


def test_noise_has_rms_1_and_the_spectrum_of_the_digits() -> None:
    triplets = draw(40)
    torch.testing.assert_close(triplets.noise.square().mean(-1), torch.ones(40))
    levels = []
    for signals in (triplets.noise, triplets.speech):
        powers = torch.fft.rfft(signals).abs().square().mean(0)
        octaves = [powers[int(1.5 * hz) : int(6.0 * hz)].sum() for hz in (250, 500, 1000, 2000)]
        levels.append(10.0 * (torch.stack(octaves) / powers.sum()).log10())
    torch.testing.assert_close(*levels, atol=1.5, rtol=0.0)


def test_noise_of_the_ear_has_the_spectrum_level_of_the_standard() -> None:
    internal = draw(40).internal
    powers = torch.fft.rfft(internal).abs().square().mean(0)
    density = 2.0 * powers / (internal.shape[-1] * 16000.0)  # Pa^2 per hertz
    for hz, expected in ((250, -3.9), (1000, -12.5), (4000, -25.9)):
        level = 10.0 * density[3 * hz - 60 : 3 * hz + 60].mean().log10() + 94.0
        assert float(level) == pytest.approx(expected, abs=0.5)


def test_presented_levels_are_those_of_digits_and_noise() -> None:
    triplets = draw(2)
    only_noise = present(triplets, torch.full((2,), -100.0), 65.0)
    torch.testing.assert_close(only_noise, set_level(triplets.noise, 65.0), rtol=1e-3, atol=1e-6)
    speech = present(triplets, torch.full((2,), 20.0), 65.0) - only_noise
    factor = 10.0 ** ((85.0 - 94.0) / 20.0)
    torch.testing.assert_close(speech, factor * triplets.speech, rtol=1e-3, atol=1e-5)


def test_a_seed_decides_all_random_numbers() -> None:
    for same, again, other in zip(draw(2), draw(2), draw(2, seed=1), strict=True):
        assert torch.equal(same, again) and not torch.equal(same, other)


@pytest.mark.parametrize("threshold", [-12.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_known_thresholds_are_found_within_their_interval(threshold: float) -> None:
    rng = np.random.default_rng(0)
    snr = threshold + np.linspace(-8.0, 8.0, 200)
    span = 0.9 - 0.01
    share = 0.1 + span * expit(0.4 * (snr - threshold) + logit((TARGET - 0.1) / span))
    inside, errors = [], []
    for _ in range(10):
        estimate = estimate_threshold(snr, rng.binomial(3, share))
        inside.append(estimate.low <= threshold <= estimate.high)
        errors.append(estimate.value - threshold)
    assert abs(np.mean(errors)) < 0.3 and np.mean(inside) >= 0.85


def test_a_threshold_that_is_never_reached_is_infinite() -> None:
    estimate = estimate_threshold(np.linspace(-20.0, 30.0, 60), np.zeros(60))
    assert estimate == (np.inf, np.inf, np.inf)
    assert np.isnan(subtract(estimate, estimate).value)
    assert subtract(estimate, Estimate(1.0, 0.0, 2.0)).value == np.inf


@pytest.mark.parametrize("settings", [{"bands": 7}, {"channels": 257}, {"bands": 8.5}])
def test_sizes_of_a_listener_are_checked(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="whole number"):
        DigitListenerConfig(**settings)


def test_shipped_listener_is_small_and_hears_what_was_measured() -> None:
    folder = checkpoints_folder() / "digit-listener"
    assert sum(path.stat().st_size for path in folder.iterdir()) < 1_000_000
    assert share_right("NH", 5.0) >= 0.95
    assert share_right("NH", -30.0) <= 0.3
    assert share_right("N4", 15.0) >= 0.8


@pytest.mark.slow
def test_louder_noise_and_a_worse_ear_leave_fewer_digits() -> None:
    louder = share_right("N2", -25.0, noise_spl=80.0), share_right("N2", -5.0, noise_spl=60.0)
    assert louder[0] < louder[1]
    assert share_right("N5", -5.0) < share_right("N3", -5.0) <= share_right("NH", -5.0)


def test_a_worse_ear_has_a_higher_threshold_and_gain_lowers_it() -> None:
    result = reception_threshold(["NH", "N3", "N5"], lambda x, _: 10.0 * x, **QUICK)
    normal, moderate, severe = result.unaided.value
    assert normal + 1.0 < moderate and moderate + 3.0 < severe
    assert result.benefit is not None and result.aided is not None
    assert result.benefit.value[2] > 3.0
    np.testing.assert_array_equal(result.benefit.value, result.unaided.value - result.aided.value)
    assert result.pta.tolist() == [0.0, 46.25, 76.25]
    for estimate in (result.unaided, result.aided, result.benefit):
        assert (estimate.low < estimate.value).all() and (estimate.value < estimate.high).all()


def test_the_same_call_has_the_same_bits_and_ears_are_independent() -> None:
    first = reception_threshold(["N2", "N4"], "nalr", **QUICK)
    alone = reception_threshold("N4", "nalr", **QUICK)
    for name in ("unaided", "aided", "benefit"):
        both, single = (np.array(getattr(result, name)) for result in (first, alone))
        assert both[:, 1].tolist() == single.tolist()
    listener = reception_threshold(Listener("N2", "N4"), **QUICK)
    assert listener.unaided.value.tolist() == first.unaided.value.tolist()
    assert reception_threshold("N4", seed=1, **QUICK).unaided.value != alone.unaided.value


@pytest.mark.slow
def test_threads_share_the_triplets_and_do_not_change_the_threshold() -> None:
    calls: set[tuple[bool, int]] = set()

    class Recorder(Attenuation):
        def forward(self, waveform: torch.Tensor, audiogram: Any = None) -> torch.Tensor:
            is_main_thread = threading.current_thread() is threading.main_thread()
            calls.add((is_main_thread, len(waveform)))
            return super().forward(waveform, audiogram)

    simulator, threads = Recorder(), torch.get_num_threads()
    results = []
    try:
        for number in (1, 2):
            torch.set_num_threads(number)
            results.append(reception_threshold("N4", simulator=simulator, triplets=60).unaided)
    finally:
        torch.set_num_threads(threads)
    assert results[0] == results[1]
    assert calls == {(True, 4), (False, 4)}


def test_people_have_the_two_lines_that_were_fitted() -> None:
    people = people_threshold([0.0, 30.0, 50.0])  # docs/figures/digits_people.py
    np.testing.assert_allclose(people.value, [-9.21, -6.24, -0.62], atol=0.01)
    assert (np.diff(people.high - people.low) > 0.0).all()
    result = reception_threshold(["NH", "N3"], **QUICK)
    np.testing.assert_array_equal(result.people.value, people_threshold([0.0, 46.25]).value)


def test_sliders_reach_the_aid() -> None:
    gains = []

    def aid(signals: torch.Tensor, ear: torch.Tensor, gain: float) -> torch.Tensor:
        gains.append(gain)
        return signals

    result = reception_threshold("N2", aid, gain=0.5, **QUICK)
    assert set(gains) == {0.5}
    assert result.benefit is not None and result.benefit.value == 0.0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"audiogram": "N7"}, "-10 to 100 dB HL"),
        ({"aid": "no-such"}, "no checkpoint"),
        ({"aid": "neuro-msbg"}, "load it with load_pretrained"),
        ({"simulator": "no-such"}, "no checkpoint"),
        ({"listener": "hearing-aid"}, "expected a checkpoint of kind digit-listener"),
        ({"noise_spl": 20.0}, "noise_spl to be a number from 40 to 90"),
        ({"triplets": 3}, "triplets to be a whole number"),
        ({"seed": -1}, "seed"),
        ({"noise_reduction": 0.5}, "no effect without an aid"),
        ({"aid": "hearing-aid-directional"}, "an aid with one microphone"),
        ({"aid": NALR(sample_rate=44100)}, "an aid with sample_rate=16000, got 44100"),
        ({"aid": NALR(full_scale_spl=100.0)}, "an aid with full_scale_spl=94"),
        ({"aid": lambda x, _: x[..., :-1]}, "expected the aid to return .* of shape"),
        ({"aid": lambda x, _: x * float("nan")}, "the output of the aid .* NaN or infinite"),
        ({"aid": lambda x, _: (32767 * x).short()}, "floating-point tensor .* got torch.int16"),
        ({"aid": lambda x, _: x.numpy()}, "expected the aid to return .* got ndarray"),
    ],
)
def test_invalid_arguments_are_rejected(settings: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        reception_threshold(**{"audiogram": "N3", **QUICK, **settings})


def test_a_test_has_enough_triplets_for_its_three_rounds() -> None:
    with pytest.raises(ValueError, match="triplets to be a whole number from 30"):
        DigitTest.draw(2, simulator="attenuation")


def test_other_loaders_name_the_loader_of_a_listener() -> None:
    with pytest.raises(ValueError, match=r"load it with hlsim\.evaluation\.digits\.load_listener"):
        hlsim.load_pretrained("digit-listener")
    assert "digit-listener" not in hlsim.list_pretrained()


def test_command_prints_a_line_per_ear(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    quick = "--simulator attenuation --triplets 30".split()
    words = "srt --audiogram N2 --audiogram N4 --compensator nalr".split()
    assert main([*words, *quick]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in lines] == ["N2", "N4"]
    assert all(word in lines[1] for word in ("unaided", "aided", "benefit", "people", "62 dB HL"))
    table = tmp_path / "ears.csv"
    table.write_text("listener,L500,L4000,R500,R4000\nA,20,30,50,60\n")
    assert main(["srt", "--listener", str(table), *quick]) == 0
    assert [line[:5] for line in capsys.readouterr().out.splitlines()] == ["left,", "right"]
    assert main(["srt", "--audiogram", "N2", "--noise-reduction", "1", *quick]) == 2
    assert "no effect without an aid" in capsys.readouterr().err


def test_command_says_that_a_threshold_is_above_the_range(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    deaf = Estimate(*np.full((3, 1), np.inf))
    measured = Estimate(*np.array([[20.0], [19.0], [21.0]]))
    for aided in (deaf, measured):
        result = ReceptionThreshold(
            deaf, aided, subtract(deaf, aided), np.array([90.0]), people_threshold(np.array([90.0]))
        )
        monkeypatch.setattr(
            "hlsim.evaluation.digits.reception_threshold", Mock(return_value=result)
        )
        assert main("srt --audiogram N6 --compensator nalr".split()) == 0
        line = capsys.readouterr().out
        assert "unaided above 32 dB, aided" in line and "benefit unknown, people" in line
    assert "aided 20.0 dB [19.0, 21.0]" in line


@torch.no_grad()
def test_speech_and_noise_pass_the_gains_that_the_aid_has_for_their_sum() -> None:
    figure = load_figure("digits_noise_reduction.py")
    aid = hlsim.load_compensator("hearing-aid")
    triplets = draw(1)
    mixture = present(triplets, torch.zeros(1), 65.0)[:, :6400]
    speech = 0.5 * triplets.speech[:, :6400]
    attenuation = aid.attenuation(mixture)
    parts = [figure.attenuate(part, attenuation) for part in (speech, mixture - speech)]
    output = aid(mixture, "NH", noise_reduction=1.0, amplification=0.0)
    assert float(attenuation.min()) < -1.0
    torch.testing.assert_close(sum(parts)[:, 64:], output[:, :-64], rtol=1e-4, atol=1e-7)


def test_a_listener_that_was_trained_again_is_loaded_again(tmp_path: Path) -> None:
    listeners = []
    for channels in (2, 2, 3):
        DigitListener(DigitListenerConfig(channels=channels)).save_pretrained(tmp_path)
        listeners.append(load_listener(tmp_path))
        assert load_listener(tmp_path) is listeners[-1]
    assert len({*listeners}) == 3
