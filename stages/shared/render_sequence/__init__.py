"""An outfit rendered through a motion into frames, passes, splat files, a video and a contact sheet."""
