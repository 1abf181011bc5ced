"""The radio passes its band, adds the noise that it says, clips, drops out, and is a function of its seed."""

import dataclasses as dc
import math

import numpy as np
import pytest

from valve_drake.voice import radio as mut

SECOND = mut.RATE


def tone(frequency, seconds=2.0, amplitude=0.3):
    return amplitude * np.sin(2 * np.pi * frequency * np.arange(int(seconds * SECOND)) / SECOND)


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


@pytest.mark.parametrize("frequency", [500, 1000, 2500])
def test_tones_within_the_band_come_out_at_the_receivers_level(frequency):
    out = mut.transmit(tone(frequency), mut.CLEAN, seed=0)
    assert out.dtype == np.float32 and out.shape == (2 * SECOND,)
    assert abs(rms(out[SECOND // 2 :]) / mut.LEVEL - 1) < 0.03


@pytest.mark.parametrize("frequency", [50, 120, 6000])
def test_tones_beside_the_band_are_gone(frequency):
    assert rms(mut.transmit(tone(frequency), mut.CLEAN, seed=0)[SECOND // 2 :]) < 0.03 * mut.LEVEL


@pytest.mark.parametrize("snr", [0.0, 10.0, 20.0])
def test_the_noise_is_as_far_below_the_speech_as_it_says(snr):
    quiet = dc.replace(mut.CLEAN, snr=snr)
    noise = mut.transmit(np.zeros(20 * SECOND), quiet, seed=3, level=1.0)
    assert abs(20 * math.log10(mut.LEVEL / rms(noise)) - snr) < 0.3


def test_loud_parts_are_cut_before_the_band():
    out = mut.transmit(tone(500, amplitude=0.9), dc.replace(mut.CLEAN, clipping=0.5), seed=0)
    spectrum = np.abs(np.fft.rfft(out[SECOND:] * np.hanning(SECOND)))
    assert spectrum[1500] > 0.2 * spectrum[500], "the third harmonic of a square"


def test_a_dropout_leaves_nothing_of_the_speech():
    steady = dc.replace(mut.CLEAN, dropouts=2.0)
    out = mut.transmit(tone(1000, 10.0), steady, seed=5)
    loud = np.array([rms(part) for part in out.reshape(-1, 160)])  # each 10 ms
    silent = (loud[50:] < 0.1 * mut.LEVEL).sum()
    assert 20 < silent < 200, "twenty times 20 to 80 ms, less the filter's ends"


def test_the_same_seed_gives_the_same_samples_and_another_seed_others():
    x = tone(700)
    a, b, c = (mut.transmit(x, mut.AT_10_DB, seed) for seed in (1, 1, 2))
    assert np.array_equal(a, b) and not np.array_equal(a, c)


def test_silence_stays_silence_on_a_clean_radio_and_full_scale_is_never_passed():
    assert not mut.transmit(np.zeros(1000), mut.CLEAN, seed=0).any()
    assert len(mut.transmit(np.zeros(0), mut.AT_10_DB, seed=0)) == 0
    loud = mut.transmit(100 * tone(900), dc.replace(mut.AT_10_DB, snr=-20.0), seed=0)
    assert np.abs(loud).max() <= 1.0 and np.isfinite(loud).all()


def test_the_loudness_of_speech_leaves_its_pauses_out():
    x = np.concatenate([tone(300), np.zeros(6 * SECOND)])
    assert mut.loudness(x) == pytest.approx(0.3 / math.sqrt(2), rel=0.01)
