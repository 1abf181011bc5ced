"""What an operator says over a radio: the radio, synthetic voices, and a recogniser of a closed vocabulary."""
