// Pictures of sounds: time to the right, pitch upwards, and brighter where more of the sound is audible.

import { SAMPLE_RATE } from "./windows.js";

const POINTS = 512;
const LOWEST_HZ = 100;
const HIGHEST_HZ = 8000;
const SOFTEST_SPL = 0; // dB SPL per frequency, drawn black
const LOUDEST_SPL = 60; // dB SPL per frequency, drawn in the brightest colour
const PASCAL_SPL = 94;

// Colours from soft to loud, those of matplotlib's "inferno".
const COLOURS = [
  [0, 0, 4], [22, 11, 57], [66, 10, 104], [106, 23, 110], [147, 38, 103],
  [188, 55, 84], [221, 81, 58], [243, 120, 25], [252, 165, 10], [246, 215, 70], [252, 255, 164],
];

const window_ = Float32Array.from({ length: POINTS }, (_, i) => 0.5 - 0.5 * Math.cos((2 * Math.PI * i) / POINTS));
const windowPower = window_.reduce((sum, weight) => sum + weight * weight, 0);

const mel = (hertz) => Math.log(1 + hertz / 700);

export function hertzAt(share) {
  const low = mel(LOWEST_HZ);
  return 700 * (Math.exp(low + share * (mel(HIGHEST_HZ) - low)) - 1);
}

export function shareOf(hertz) {
  return (mel(hertz) - mel(LOWEST_HZ)) / (mel(HIGHEST_HZ) - mel(LOWEST_HZ));
}

export function drawSpectrogram(canvas, pascals) {
  const context = canvas.getContext("2d");
  const { width, height } = canvas;
  const image = context.createImageData(width, height);
  const bins = Array.from({ length: height }, (_, row) => {
    const hertz = hertzAt(1 - (row + 0.5) / height);
    return (hertz / SAMPLE_RATE) * POINTS;
  });
  const real = new Float32Array(POINTS);
  const imaginary = new Float32Array(POINTS);
  const levels = new Float32Array(POINTS / 2 + 1);
  for (let column = 0; column < width; column++) {
    const start = Math.round(((column + 0.5) / width) * pascals.length - POINTS / 2);
    for (let i = 0; i < POINTS; i++) real[i] = window_[i] * (pascals[start + i] ?? 0);
    imaginary.fill(0);
    transform(real, imaginary);
    for (let bin = 0; bin < levels.length; bin++) {
      const power = (2 * (real[bin] ** 2 + imaginary[bin] ** 2)) / (POINTS * windowPower);
      levels[bin] = 10 * Math.log10(power + 1e-12) + PASCAL_SPL;
    }
    bins.forEach((bin, row) => {
      const low = Math.floor(bin);
      const high = Math.min(low + 1, levels.length - 1);
      const level = levels[low] + (bin - low) * (levels[high] - levels[low]);
      const share = (level - SOFTEST_SPL) / (LOUDEST_SPL - SOFTEST_SPL);
      image.data.set(colour(share), 4 * (row * width + column));
    });
  }
  context.putImageData(image, 0, 0);
}

function colour(share) {
  const position = Math.min(Math.max(share, 0), 1) * (COLOURS.length - 1);
  const low = Math.min(Math.floor(position), COLOURS.length - 2);
  const [red, green, blue] = COLOURS[low].map((value, i) => value + (position - low) * (COLOURS[low + 1][i] - value));
  return [red, green, blue, 255];
}

// Fourier transform in place, of a power of two of points.
function transform(real, imaginary) {
  const points = real.length;
  for (let i = 1, j = 0; i < points; i++) {
    let bit = points >> 1;
    for (; j & bit; bit >>= 1) j ^= bit;
    j ^= bit;
    if (i < j) {
      [real[i], real[j]] = [real[j], real[i]];
      [imaginary[i], imaginary[j]] = [imaginary[j], imaginary[i]];
    }
  }
  for (let size = 2; size <= points; size *= 2) {
    const half = size / 2;
    for (let k = 0; k < half; k++) {
      const cosine = Math.cos((2 * Math.PI * k) / size);
      const sine = -Math.sin((2 * Math.PI * k) / size);
      for (let even = k; even < points; even += size) {
        const odd = even + half;
        const re = real[odd] * cosine - imaginary[odd] * sine;
        const im = real[odd] * sine + imaginary[odd] * cosine;
        real[odd] = real[even] - re;
        imaginary[odd] = imaginary[even] - im;
        real[even] += re;
        imaginary[even] += im;
      }
    }
  }
}
