// The microphone: recorded to listen afterwards, or live through the hearing aid.

import { request } from "./engine.js";
import { safeOutput } from "./player.js";
import { resample } from "./sound.js";
import { SAMPLE_RATE } from "./windows.js";

const MICROPHONE_SPL = 100; // level in dB SPL of samples whose RMS is 1, as `hlsim live` assumes
const PASCAL_SPL = 94;
const PASCALS = 10 ** ((MICROPHONE_SPL - PASCAL_SPL) / 20);
const AID_DELAY = 64; // samples
const BLOCK = 128; // samples that an AudioWorklet processes at a time
export const QUEUED_BLOCKS = 5; // time that the aid has for each block

// Milliseconds from a sample at the input of the worklet to the same sample at its output.
export const LIVE_DELAY = (1000 * (QUEUED_BLOCKS * BLOCK + AID_DELAY)) / SAMPLE_RATE;

const worklet = new URL("./worklet.js", import.meta.url);

async function openMicrophone() {
  if (!navigator.mediaDevices) throw new Error("This browser offers no microphone to this page.");
  // The processing of telephone calls would change what the aid gets.
  const audio = { echoCancellation: false, noiseSuppression: false, autoGainControl: false, channelCount: 1 };
  return navigator.mediaDevices.getUserMedia({ audio }).catch(() => {
    throw new Error("The browser did not open the microphone. Allow it, and try again.");
  });
}

function closeMicrophone(stream) {
  for (const track of stream.getTracks()) track.stop();
}

// Record a mono signal at 16 kHz. `onprogress` gets the seconds so far.
export async function record(seconds, onprogress) {
  const stream = await openMicrophone();
  const context = new AudioContext();
  try {
    await context.audioWorklet.addModule(worklet);
    const source = new MediaStreamAudioSourceNode(context, { mediaStream: stream });
    const recorder = new AudioWorkletNode(context, "recorder", { channelCount: 1, channelCountMode: "explicit" });
    source.connect(recorder).connect(context.destination);
    await context.resume();
    const wanted = Math.round(seconds * context.sampleRate);
    const signal = new Float32Array(wanted);
    let length = 0;
    await new Promise((resolve) => {
      recorder.port.onmessage = ({ data }) => {
        signal.set(data.subarray(0, wanted - length), length);
        length = Math.min(wanted, length + data.length);
        onprogress(length / context.sampleRate);
        if (length === wanted) resolve();
      };
    });
    return await resample(signal, context.sampleRate);
  } finally {
    closeMicrophone(stream);
    await context.close();
  }
}

// Connect a node to the aid in the worker. Returns the node with the aid's output.
export async function connectAid(context, source, thresholds) {
  await context.audioWorklet.addModule(worklet);
  const node = new AudioWorkletNode(context, "aid", {
    channelCount: 1,
    channelCountMode: "explicit",
    outputChannelCount: [1],
    processorOptions: { gain: PASCALS, queuedBlocks: QUEUED_BLOCKS },
  });
  const { port1, port2 } = new MessageChannel();
  await request("openLive", { thresholds, port: port1 }, [port1]);
  node.port.postMessage(port2, [port2]);
  return source.connect(node);
}

export class Live {
  // `onlate` gets the share of blocks that came too late in the last half second.
  async start(thresholds, volume, onlate) {
    this.stream = await openMicrophone();
    this.context = new AudioContext({ sampleRate: SAMPLE_RATE, latencyHint: "interactive" });
    try {
      const source = new MediaStreamAudioSourceNode(this.context, { mediaStream: this.stream });
      const node = await connectAid(this.context, source, thresholds);
      let before = { blocks: 0, late: 0 };
      node.port.onmessage = ({ data }) => {
        onlate((data.late - before.late) / (data.blocks - before.blocks));
        before = data;
      };
      this.output = safeOutput(this.context, 0);
      node.connect(this.output);
      await this.context.resume();
      this.setVolume(volume, 1); // slowly, so that nothing is suddenly loud
    } catch (error) {
      await this.stop();
      // Not every browser brings a microphone to 16 kHz.
      if (error.name === "NotSupportedError") throw new Error("This browser cannot run the aid live.");
      throw error;
    }
  }

  setVolume(volume, seconds = 0.02) {
    this.output?.gain.setTargetAtTime(volume, this.context.currentTime, seconds);
  }

  fit(thresholds) {
    return request("fitLive", { thresholds });
  }

  async stop() {
    closeMicrophone(this.stream);
    if (this.context.state !== "closed") await this.context.close();
    await request("closeLive");
  }
}
