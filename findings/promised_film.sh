#!/bin/bash
# A motion photo that libvips writes again promises a film that it no longer has.
#
# The film of a motion photo is behind the JPEG, and XMP says that it is there and how long it is
# (Android, Motion Photo format 1.0: GCamera:MotionPhoto, and the items of the container). Programs
# that decode the image and write it again drop the film, because it is no part of the JPEG, but
# libvips keeps the XMP block as it is, even in a WebP and after resizing. So "MotionPhoto=1" says
# nothing about a film, and the length in it points into the compressed pixels. Galleries show a
# motion photo that does not play, and readers that cut a film out by its length return noise.
#
# Pillow keeps XMP only if the caller passes it.
#
# The cure for readers: a film is where an ISO base media file begins and can be walked. For writers:
# remove these properties.
#
# This script makes a motion photo, and fails if libvips removes the promise, or keeps the film.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q pyvips==3.0.0 pyvips-binary==8.17.3 pillow==12.0.0 av==18.1.0
"$folder/venv/bin/python" - "$folder" <<'PYTHON'
import io
import sys
from pathlib import Path

import av
import PIL
import pyvips
from PIL import Image

folder = Path(sys.argv[1])
film = io.BytesIO()
with av.open(film, "w", format="mp4") as container:
    stream = container.add_stream("mpeg4", rate=30)
    stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
    for number in range(5):
        container.mux(stream.encode(av.VideoFrame(64, 48, "yuv420p")))
    container.mux(stream.encode())
size = len(film.getvalue())

xmp = f"""<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF
 xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"><rdf:Description rdf:about=""
 xmlns:GCamera="http://ns.google.com/photos/1.0/camera/" GCamera:MotionPhoto="1"
 GCamera:MotionPhotoVersion="1"
 xmlns:Container="http://ns.google.com/photos/1.0/container/"
 xmlns:Item="http://ns.google.com/photos/1.0/container/item/"><Container:Directory><rdf:Seq>
<rdf:li rdf:parseType="Resource"><Container:Item Item:Mime="image/jpeg"
 Item:Semantic="Primary"/></rdf:li>
<rdf:li rdf:parseType="Resource"><Container:Item Item:Mime="video/mp4"
 Item:Semantic="MotionPhoto" Item:Length="{size}"/></rdf:li>
</rdf:Seq></Container:Directory></rdf:Description></rdf:RDF></x:xmpmeta>"""
still = io.BytesIO()
Image.linear_gradient("L").save(still, "JPEG", xmp=xmp.encode())
photo = folder / "photo.jpg"
photo.write_bytes(still.getvalue() + film.getvalue())

image = pyvips.Image.new_from_file(str(photo))
image.resize(0.5).write_to_file(str(folder / "libvips.jpg"))
image.write_to_file(str(folder / "libvips.webp"))
Image.open(photo).save(folder / "pillow.jpg")

version = ".".join(str(pyvips.version(part)) for part in range(3))
print("libvips", version, "Pillow", PIL.__version__)
found = {}
for name in ("photo.jpg", "libvips.jpg", "libvips.webp", "pillow.jpg"):
    data = (folder / name).read_bytes()
    found[name] = (b'GCamera:MotionPhoto="1"' in data, b"moov" in data)
    print(f"{name:13} promises a film: {found[name][0]}, has a film: {found[name][1]}")
assert found["photo.jpg"] == (True, True)
assert found["libvips.jpg"] == found["libvips.webp"] == (True, False)
assert found["pillow.jpg"] == (False, False)
PYTHON
