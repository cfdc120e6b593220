"""From hypotheses to the next view: equations (12) to (15) of the paper."""
