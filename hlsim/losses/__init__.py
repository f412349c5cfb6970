"""Training losses of aids, which compare what ears perceive, and of the networks that emulate MSBG.

These words have one meaning in the whole package:

- The *output* is what an aid, a *compensator*, sends to the impaired ear.
- The *perceived* signal is the output of a hearing-loss simulator: what the impaired ear makes of
  it. The *reference* is what it is compared with: clean speech, or what a normal ear perceives of
  it.
- A *criterion* compares the two, or output and clean speech, and returns one or several *parts*.
  The loss is the weighted sum of the parts.
- An *item* is one signal for one ear. Samples are in *pascals*: RMS 1.0 is 94 dB SPL.
"""
