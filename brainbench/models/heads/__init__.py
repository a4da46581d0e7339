"""What follows an encoder: decoders to class scores, and heads of the self-supervised objectives."""
