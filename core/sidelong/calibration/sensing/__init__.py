"""The probability of depth against exposure, learned from captures."""
