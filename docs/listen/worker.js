// The models, in a thread of their own. Requests are processed one after the other.

import * as ort from "./assets/ort.wasm.bundle.min.mjs";

ort.env.wasm.numThreads = 1; // Several threads need HTTP headers that a static host does not send.
ort.env.logLevel = "error";

// The defaults of hlsim.compensate.
const NOISE_REDUCTION = 0.5;
const AMPLIFICATION = 1;

const LOADING_FAILED = "The ear and the hearing aid could not be loaded. Reload the page.";

async function download(name) {
  const response = await fetch(`./assets/${name}.onnx`);
  if (!response.ok) throw new Error(LOADING_FAILED);
  return response.arrayBuffer();
}

async function start(bytes) {
  const session = await ort.InferenceSession.create(await bytes);
  const shapes = Object.fromEntries(session.inputMetadata.map(({ name, shape }) => [name, shape]));
  return { session, shapes };
}

// The first sound needs the runtime, which starts with the smallest model, and the simulator. The aid comes after them.
const simulatorBytes = download("simulator");
const fit = start(download("fit"));
const simulator = fit.then(() => start(simulatorBytes));
const aid = simulator.then(() => start(download("aid")));
for (const promise of [simulatorBytes, fit, simulator, aid]) promise.catch(() => {}); // Requests report the error.

function tensor(values, shape) {
  return new ort.Tensor("float32", values, shape);
}

function thresholdsTensor(thresholds) {
  return tensor(Float32Array.from(thresholds), [1, thresholds.length]);
}

async function fitted(thresholds) {
  const { session } = await fit;
  return (await session.run({ thresholds: thresholdsTensor(thresholds) })).fitted;
}

// An aid in use. Its state after silence is zeros, and the sliders are where they were set.
class AidStream {
  static async open(thresholds) {
    const stream = new AidStream();
    const { session, shapes } = await aid;
    stream.session = session;
    stream.shape = shapes.samples;
    stream.inputs = {};
    for (const [name, shape] of Object.entries(shapes)) {
      const size = shape.reduce((product, length) => product * length, 1);
      stream.inputs[name] = tensor(new Float32Array(size), shape);
    }
    const sliders = tensor(Float32Array.of(NOISE_REDUCTION, AMPLIFICATION), shapes.sliders);
    Object.assign(stream.inputs, { sliders, gliding: sliders });
    await stream.fit(thresholds);
    return stream;
  }

  async fit(thresholds) {
    this.inputs.fitted = await fitted(thresholds);
  }

  // Output for one block, 4 ms late.
  async process(block) {
    const { output, ...state } = await this.session.run({
      ...this.inputs,
      samples: tensor(block, this.shape),
    });
    for (const [name, value] of Object.entries(state)) {
      this.inputs[name.slice("next_".length)] = value;
    }
    return output.data;
  }
}

let fileStream = null;
let liveStream = null;
let livePort = null;

const requests = {
  async simulate({ samples, thresholds }) {
    const { session, shapes } = await simulator;
    const inputs = { waveform: tensor(samples, shapes.waveform), thresholds: thresholdsTensor(thresholds) };
    return (await session.run(inputs)).perceived.data;
  },

  async openAid({ thresholds }) {
    fileStream = await AidStream.open(thresholds);
  },

  async compensate({ samples }) {
    const output = new Float32Array(samples.length);
    const size = fileStream.shape[1];
    for (let start = 0; start < samples.length; start += size) {
      output.set(await fileStream.process(samples.slice(start, start + size)), start);
    }
    return output;
  },

  // Blocks come from an AudioWorklet through a port of their own, and go back through it.
  async openLive({ thresholds, port }) {
    liveStream = await AidStream.open(thresholds);
    livePort = port;
    port.onmessage = ({ data: { number, samples } }) => {
      enqueue(async () => {
        const begin = performance.now();
        const output = await liveStream.process(samples);
        const milliseconds = performance.now() - begin;
        port.postMessage({ number, output, milliseconds });
      });
    };
  },

  async fitLive({ thresholds }) {
    await liveStream?.fit(thresholds);
  },

  async closeLive() {
    livePort?.close();
    liveStream = livePort = null;
  },
};

let queue = Promise.resolve();

function enqueue(job) {
  queue = queue.then(job).catch((error) => console.error(error));
}

onmessage = ({ data: { id, name, ...parameters } }) => {
  enqueue(async () => {
    try {
      postMessage({ id, result: await requests[name](parameters) });
    } catch (error) {
      postMessage({ id, error: error.message ?? String(error) });
    }
  });
};
