// The ends of the live path in the audio thread, and a recorder.

const STATISTICS_BLOCKS = 60;

// Sends blocks to the aid, and plays each output a fixed number of blocks later. An output that comes too late is
// replaced by silence, so that the delay never grows.
class Aid extends AudioWorkletProcessor {
  constructor({ processorOptions: { gain, queuedBlocks } }) {
    super();
    this.gain = gain;
    this.queuedBlocks = queuedBlocks;
    this.number = 0;
    this.outputs = new Map();
    this.late = 0;
    this.milliseconds = 0;
    this.port.onmessage = ({ data: link }) => {
      this.link = link;
      link.onmessage = ({ data: { number, output, milliseconds } }) => {
        this.outputs.set(number, output);
        this.milliseconds = milliseconds;
      };
    };
  }

  process([[input]], [[output]]) {
    if (!this.link) return true;
    const samples = new Float32Array(output.length);
    if (input) input.forEach((sample, i) => (samples[i] = this.gain * sample));
    this.link.postMessage({ number: this.number, samples }, [samples.buffer]);
    const due = this.number - this.queuedBlocks;
    const ready = this.outputs.get(due);
    if (ready) ready.forEach((sample, i) => (output[i] = sample / this.gain));
    else if (due >= 0) this.late++;
    for (const number of this.outputs.keys()) if (number <= due) this.outputs.delete(number);
    this.number++;
    if (this.number % STATISTICS_BLOCKS === 0) {
      this.port.postMessage({ blocks: this.number, late: this.late, milliseconds: this.milliseconds });
    }
    return true;
  }
}

class Recorder extends AudioWorkletProcessor {
  process([[input]]) {
    if (input) this.port.postMessage(input.slice());
    return true;
  }
}

registerProcessor("aid", Aid);
registerProcessor("recorder", Recorder);
