// Sounds as pascals at 16 kHz, where an RMS of 1 is 94 dB SPL.

import { SAMPLE_RATE } from "./windows.js";

export const PRESENTATION_LEVEL = 65; // dB SPL, a conversation
export const LONGEST_SECONDS = 20;
const PASCAL_SPL = 94;

export function rms(signal) {
  let sum = 0;
  for (const sample of signal) sum += sample * sample;
  return Math.sqrt(sum / signal.length);
}

export function levelOf(signal) {
  return 20 * Math.log10(rms(signal) + 1e-9) + PASCAL_SPL;
}

// The first seconds of a mono signal, scaled to the level of a conversation.
export function present(signal) {
  const part = signal.slice(0, LONGEST_SECONDS * SAMPLE_RATE);
  const level = rms(part);
  if (!(level > 1e-6)) throw new Error("The sound is silent. Choose another one.");
  const gain = 10 ** ((PRESENTATION_LEVEL - PASCAL_SPL) / 20) / level;
  return part.map((sample) => gain * sample);
}

// Samples of an audio file in any format that the browser knows, its channels averaged.
export async function decode(bytes) {
  const context = new OfflineAudioContext(1, 1, SAMPLE_RATE);
  const buffer = await context.decodeAudioData(bytes).catch(() => {
    throw new Error("The browser cannot read this file. Choose a WAV, MP3 or FLAC file.");
  });
  return mix(buffer);
}

// A mono signal at another rate, at 16 kHz.
export async function resample(signal, rate) {
  const length = Math.max(1, Math.round((signal.length * SAMPLE_RATE) / rate));
  const context = new OfflineAudioContext(1, length, SAMPLE_RATE);
  const buffer = context.createBuffer(1, signal.length, rate);
  buffer.copyToChannel(signal, 0);
  const source = new AudioBufferSourceNode(context, { buffer });
  source.connect(context.destination);
  source.start();
  return mix(await context.startRendering());
}

function mix(buffer) {
  const mono = new Float32Array(buffer.length);
  for (let channel = 0; channel < buffer.numberOfChannels; channel++) {
    buffer.getChannelData(channel).forEach((sample, i) => (mono[i] += sample / buffer.numberOfChannels));
  }
  return mono;
}
