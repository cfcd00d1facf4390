"""What the answer to each case must show, by the name of its folder.

A rule is a regular expression that the output of the case's command must contain, or, with a leading "!",
must not contain. Output is stdout and stderr together. No case may end in a traceback or a report of a bug.
"""

from __future__ import annotations

FFMPEG_PLACE = "tools/venv/lib/python3.11/site-packages/imageio_ffmpeg/binaries/ffmpeg"

RULES: dict[str, tuple[str, ...]] = {
    "01-bvh-fixed-root-above-hips": (r"across hips +angle error mean +0\.0", r"bvh 1\.4\d+ gw 1\.4"),
    "02-bvh-person-lies": (r"across hips +angle error mean +0\.0", "!angle error mean +[1-9]"),
    "04-bvh-rest-pose-bones-along-x": ("not a standing person",),
    "05-bvh-name-prefixes": (r"(?s)rc=0.*rc=0", "!rc=65"),
    "06-utf8-bom": (r"frames: \d+", "!BOM", "!zip archive"),
    "08-bvh-frame-count-off-by-one": (r"(?s)holds 40 rows.*rc=0", r"line \d+ has 95 numbers", "rc=65"),
    "09-easymocap-smpl-72": (r"(?s)rc=0.*rc=0", "!rc=65"),
    "10-silent-units-and-axes": ("--degrees", "--length-unit", "--up z", "--up y"),
    "12-per-frame-betas": ("mean is kept", "rc=0"),
    "13-amass-keys": (r"(?s)rc=0.*frames per second are assumed.*rc=0",),
    "14-lens-distortion": ("lens distortion", "rc=65"),
    "16-mask-in-alpha": ("rc=0", r"masks are inverted", "rc=65"),
    "18-film-colours-untagged": ("bt709",),
    "19-memory-of-large-pictures": ("!A bug in gw", "rc=(65|2|75)"),
    "21-compressed-ply": (r"(?i)compressed|SuperSplat|PlayCanvas",),
    "01-bundle-model-config": ("!rc 70", "!rc 124"),
    "02-one-bad-card-hides-wardrobe": ("good", "cannot be used|error"),
    "03-terminal-escapes": ("(?m)^0$", "!(?m)^next: curl"),
    "04-wardrobe-outfits-exponential": ("rc 2",),
    "05-wardrobe-add-race": ("has another|another process",),
    "07-poses-not-finite-after-cast": ("rc 65", "!rc 0", "!rc 70"),
    "08-poses-exit-70": ("rc 65", "!rc 70", "!rc 0"),
    "10-npz-bomb": ("4200000 frames",),
    "11-labels-16-bit": ("rc 0|mean nothing", "!layers: body$"),
    "12-jpeg-cut-but-ended": ("image is damaged",),
    "14-camera-distortion": ("lens distortion", "rc 65"),
    "14-camera-last-row": ("0 0 0 1", "rc 65"),
    "14-camera-width-448.9": (r"448\.9", "rc 65"),
    "16-swapped-opposite-cameras": ("exchanged",),
    "18-empty-mask-seen-late": ("(?s)dry 65.*run 65|run 0",),
    "19-train-digest-by-the-clock": ("!differ", "!No such file", r"(?s)written|steps: 60"),
    "21-view-requests": ("!EMPTY", "(?m)^0$"),
    "22-view-foreign-origin": ("403",),
    "23-bvh-dialects": ("rc 0", "!rc 65"),
    "25-streams": (r"closed stdout (0|74)", r"ascii help 0", "!broken pipe 70"),
    "27-sigterm-of-tryon": ("rc 130", "interrupted"),
    "28-misleading-refusals": ("rc 0|JPG",),
    "30-silent-choices": ("Two takes are called", "rc 65"),
}
# Shell lines before the command of a case, for what it expects to find.
BEFORE = {
    "18-film-colours-untagged": f'mkdir -p "$(dirname {FFMPEG_PLACE})"; ln -s "$FFMPEG" {FFMPEG_PLACE}',
    "22-view-foreign-origin": (
        'cp "$DEMO"/wardrobe/body_1.gwg "$DEMO"/wardrobe/skirt.gwg .; '
        "gw view body_1.gwg skirt.gwg --port 8771 2>/dev/null & "
        "until curl -s -o page.html http://127.0.0.1:8771/; do sleep 0.5; done"
    ),
}
