"""Pictures of frames, maps and errors, made without a display."""
