"""Description of recordings in words, and their display in the rerun viewer: in a window, a file or a picture.

The motion is taken from the recording; nothing is simulated again. Start with `show` and `description`; `viewer_stream`
sends channels and motion, `outputs` opens the window or writes the file, `rerun_viewer` starts the viewer.
"""
