"""A real RTSP server for the tests, run by the system's Python, which has GStreamer's bindings.

rtsp_server.py PORT WIDTH HEIGHT RATE: serves /h264, /reordered and /mjpeg, a moving ball.
PORT 0 takes a free one.
Prints `port N` once it listens.
"""

from __future__ import annotations

import sys

import gi

gi.require_version("Gst", "1.0")
gi.require_version("GstRtspServer", "1.0")
from gi.repository import GLib, Gst, GstRtspServer  # noqa: E402

ENCODERS = {
    "h264": "x264enc tune=zerolatency speed-preset=ultrafast key-int-max=10 ! rtph264pay name=pay0 pt=96",
    # Pictures that refer to later ones: sent out of order, and stamped so.
    "reordered": "x264enc bframes=2 key-int-max=12 speed-preset=ultrafast rc-lookahead=4 sync-lookahead=0 "
    "! video/x-h264,profile=main ! rtph264pay name=pay0 pt=96",
    "mjpeg": "jpegenc ! rtpjpegpay name=pay0 pt=26",
}

port, width, height, rate = (int(word) for word in sys.argv[1:5])
Gst.init(None)
server = GstRtspServer.RTSPServer()
server.set_address("127.0.0.1")
server.set_service(str(port))
for name, encoder in ENCODERS.items():
    factory = GstRtspServer.RTSPMediaFactory()
    factory.set_launch(
        f"( videotestsrc is-live=true pattern=ball ! video/x-raw,format=I420,width={width},height={height},"
        f"framerate={rate}/1 ! {encoder} )"
    )
    factory.set_shared(True)
    server.get_mount_points().add_factory(f"/{name}", factory)
if not server.attach(None):
    sys.exit("can't listen")
print("port", server.get_bound_port(), flush=True)
GLib.MainLoop().run()
