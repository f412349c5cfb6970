"""The exact MSBG model of hearing loss.

These words have one meaning in the whole package:

- The *model rate* is 44.1 kHz, at which MSBG is defined. Aligned signals with a sample rate of up
  to 20 kHz run at half of it, 22.05 kHz. The parameter ``rate_divisor`` is 1 or 2 accordingly.
- The *cochlea* is the part of the model with gains that depend on the level. A bank of band-pass
  filters, the *filter bank*, splits the signal into 19 to 36 *channels*, and *recruitment*
  multiplies each channel by a gain that follows its envelope. The wider filters of worse ears need
  fewer channels.
- The *envelope* of a channel is its slowly varying magnitude. Envelopes and gains are computed once
  per *step* of 24 samples at 44.1 kHz (24.5 if signals run at 22.05 kHz), and gains are
  interpolated in between.
- *Smearing* blurs the spectrum before the cochlea, as the wider filters of an impaired ear do.
- The *severity* of a loss, ``"none"``, ``"mild"``, ``"moderate"`` or ``"severe"``, selects the
  filter bank and the amount of smearing.
"""

from hlsim.msbg.model import MSBG, estimate_delay

__all__ = ["MSBG", "estimate_delay"]
