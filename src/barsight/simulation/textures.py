"""Synthesise surface texture: tiles of noise band-limited to the resolution of the image sensor."""

from __future__ import annotations

import cv2
import numpy as np

from barsight.core.arrays import Float32, Float64, UInt8

TILE = 1024
"""Texels per side; a power of two, so that an index wraps with a mask."""
AROUND_M = 0.0015
"""Texel size across a bar, m."""
ALONG_M = 0.002
"""Texel size along a bar, m."""


def surface_tile(rng: np.random.Generator, footprint_m: float, texture_ratio: float = 1.0) -> Float32:
    """Synthesise a (TILE, TILE, 4) periodic float32 tile, first axis around the bar, second along it.

    Channels: albedo factor (mean 1), gloss factor (mean 1), slope of the surface around the bar (rad),
    isotropic albedo factor in texels of ALONG_M for floor and wood (mean 1). footprint_m: size of a pixel on
    the floor. The pattern is designed for 6.4 mm and scales with it, so that a coarser camera also finds
    contrast at the scale of its pixels and nothing finer that would alias. texture_ratio: contrast of all
    channels relative to the ordinary.
    """
    grown = float(np.clip(footprint_m / 0.0064, 0.8, 8.0))
    streaks = _noise(rng, 0.0035 * grown, 0.05)
    scale = _noise(rng, 0.007 * grown, 0.018 * grown)
    grain = _noise(rng, 0.0024 * grown, 0.003 * grown)
    rust = _noise(rng, 0.02, 0.06)
    specks = _noise(rng, 0.0025 * grown, 0.007 * grown)
    albedo = np.exp(0.11 * streaks + 0.09 * scale + 0.13 * grain + 0.08 * rust)
    albedo *= np.where(specks > 2.5, 0.6, 1.0)
    gloss = np.exp(0.3 * scale + 0.2 * grain - 0.25 * rust)
    slope = 0.10 * _noise(rng, 0.012, 0.05) + 0.05 * _noise(rng, 0.004 * grown, 0.012 * grown)
    coarse = (
        _noise(rng, 0.0035 * grown, 0.0035 * grown) * 0.09 + _noise(rng, 0.015 * grown, 0.015 * grown) * 0.05
    )
    tile = np.stack([albedo / albedo.mean(), gloss / gloss.mean(), slope, np.exp(coarse)], axis=2)
    if texture_ratio != 1:
        plain = np.array([1.0, 1.0, 0.0, 1.0])
        tile = plain + texture_ratio * (tile - plain)
    return np.ascontiguousarray(tile, dtype=np.float32)


def _noise(rng: np.random.Generator, around_m: float, along_m: float) -> Float64:
    """Draw (TILE, TILE) periodic Gaussian noise, zero mean, unit variance, smoothed with these sigmas."""
    spectrum = np.fft.rfft2(rng.standard_normal((TILE, TILE)))
    f_around = np.fft.fftfreq(TILE, AROUND_M)[:, None]
    f_along = np.fft.rfftfreq(TILE, ALONG_M)[None, :]
    spectrum *= np.exp(-2 * np.pi**2 * ((f_around * around_m) ** 2 + (f_along * along_m) ** 2))
    spectrum[0, 0] = 0
    noise = np.fft.irfft2(spectrum, s=(TILE, TILE))
    scaled: Float64 = noise / noise.std()
    return scaled


def label_text(seed: int, number: int) -> str:
    """Return the nine digits on the label of bundle `number`, counted from 1."""
    return f"{seed % 100000:05d}{number:04d}"


def label_codes(seed: int, count: int) -> UInt8:
    """Encode the texts of bundles 1 to count as QR codes (count, S, S).

    One cell per module, 0 dark, with a quiet zone of two modules.
    """
    encoder = cv2.QRCodeEncoder.create()
    codes = [encoder.encode(label_text(seed, number)) for number in range(1, count + 1)]
    return np.stack(codes)
