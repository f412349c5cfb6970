// Playback of several versions of a sound, which can be switched while they play.

import { SAMPLE_RATE } from "./windows.js";

const FADE_SECONDS = 0.03;
const FULL_SCALE_SPL = 88; // level in dB SPL that plays with an RMS of 1 at full volume
const PASCAL_SPL = 94;
export const PEAK = 0.5; // largest sample that the limiter lets pass

// Volume, then a limiter: x / (1 + |x / PEAK|^8)^(1/8), as the hearing aid has one.
export function safeOutput(context, volume) {
  const points = 4097;
  const curve = Float32Array.from({ length: points }, (_, i) => {
    const sample = (2 * i) / (points - 1) - 1;
    return sample / (1 + Math.abs(sample / PEAK) ** 8) ** (1 / 8);
  });
  const gain = new GainNode(context, { gain: volume });
  const limiter = new WaveShaperNode(context, { curve });
  gain.connect(limiter).connect(context.destination);
  return gain;
}

export class Player {
  constructor(volume) {
    this.volume = volume;
    this.buffers = new Map();
    this.repeat = false;
    this.playing = null; // name of the version that is heard
    this.onchange = () => {};
    this.tracks = new Map();
  }

  // The browser allows sound only after the user has touched the page, so the context comes late.
  get context() {
    if (!this._context) {
      this._context = new AudioContext();
      this.output = safeOutput(this._context, this.volume);
    }
    return this._context;
  }

  setVolume(volume) {
    this.volume = volume;
    if (this._context) this.output.gain.setTargetAtTime(volume, this._context.currentTime, 0.02);
  }

  // Replace a version. It goes on from the same position if it is playing.
  set(name, pascals) {
    const gain = 10 ** ((PASCAL_SPL - FULL_SCALE_SPL) / 20);
    const buffer = new AudioBuffer({ length: pascals.length, sampleRate: SAMPLE_RATE });
    buffer.copyToChannel(pascals.map((sample) => gain * sample), 0);
    this.buffers.set(name, buffer);
    if (this.playing === null) return;
    this._fadeOut(name);
    this._start(name, this.position);
  }

  has(name) {
    return this.buffers.has(name);
  }

  get duration() {
    const [buffer] = this.buffers.values();
    return buffer ? buffer.duration : 0;
  }

  get position() {
    if (this.playing === null) return 0;
    const seconds = Math.max(0, this.context.currentTime - this.startTime);
    return this.repeat ? seconds % this.duration : Math.min(seconds, this.duration);
  }

  // Play a version from the beginning, or switch to it where another one is.
  async play(name) {
    await this.context.resume();
    if (this.playing === null) {
      this.startTime = this.context.currentTime;
      this.playing = name;
      for (const version of this.buffers.keys()) this._start(version, 0);
    } else {
      this.playing = name;
      const now = this.context.currentTime;
      for (const [version, { gain }] of this.tracks) {
        gain.gain.setTargetAtTime(version === name ? 1 : 0, now, FADE_SECONDS / 3);
      }
    }
    this.onchange();
  }

  stop() {
    for (const name of [...this.tracks.keys()]) this._fadeOut(name);
    this.playing = null;
    this.onchange();
  }

  setRepeat(repeat) {
    if (this.playing !== null) this.startTime = this.context.currentTime - this.position;
    this.repeat = repeat;
    for (const { source } of this.tracks.values()) source.loop = repeat;
  }

  // Forget all versions.
  clear() {
    this.stop();
    this.buffers.clear();
  }

  _start(name, position) {
    const { context } = this;
    const source = new AudioBufferSourceNode(context, { buffer: this.buffers.get(name), loop: this.repeat });
    const gain = new GainNode(context, { gain: 0 });
    gain.gain.setTargetAtTime(name === this.playing ? 1 : 0, context.currentTime, FADE_SECONDS / 3);
    source.connect(gain).connect(this.output);
    source.start(0, position);
    source.onended = () => {
      if (this.tracks.get(name)?.source !== source) return;
      this.tracks.delete(name);
      if (name === this.playing) this.stop();
    };
    this.tracks.set(name, { source, gain });
  }

  _fadeOut(name) {
    const track = this.tracks.get(name);
    if (!track) return;
    this.tracks.delete(name);
    const now = this.context.currentTime;
    track.gain.gain.setTargetAtTime(0, now, FADE_SECONDS / 3);
    track.source.stop(now + 2 * FADE_SECONDS);
  }
}
