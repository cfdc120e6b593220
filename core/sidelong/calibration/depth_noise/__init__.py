"""How noisy depth is: from captures of a flat plate, or from repeated shots of any scene."""
