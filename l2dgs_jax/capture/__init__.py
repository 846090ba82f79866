"""From a video or a folder of frames to frames with poses: what `prepare` is made of."""
