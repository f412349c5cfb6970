"""Names of the conditions that several studies and their pages share."""

UNAIDED = "unaided"
"""No aid: the output is the input."""

NAL_R = "NAL-R"
"""The linear prescription NAL-R."""

COMPRESSION = "WDRC"
"""The wide dynamic range compressor."""

BEFORE, AFTER = "before", "after"
"""Recorded speech before and after a treatment."""

NAL_R_AT_LEVEL, TRAINED = "NAL-R, same level", "trained aid"
"""NAL-R at the output level of the aid that the demo trains, and this aid."""
