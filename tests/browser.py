"""A browser that plays a video and says what it saw, or draws a page."""

import http.server
import queue
import subprocess
import threading
from urllib.parse import unquote

PAGE = b"""<video src="/video" muted autoplay></video><script>
const video = document.querySelector("video");
const say = (...words) => fetch("/said/" + words.join(" "));
video.onerror = () => say("error", video.error.message);
video.onended = () => {
  const canvas = Object.assign(document.createElement("canvas"), {width: video.videoWidth, height: video.videoHeight});
  const pen = canvas.getContext("2d");
  pen.drawImage(video, 0, 0);
  const middle = pen.getImageData(video.videoWidth / 2, video.videoHeight / 2, 1, 1).data;
  say("ended", video.videoWidth, video.videoHeight, ...middle);
};
</script>"""


def played(path, profile, seconds=30):
    """What Chromium says once the video is over: "ended", width, height, and red, green, blue of the middle pixel.

    Virtual time would be over before a video is, so a server on this machine waits for the word.
    """
    said = queue.Queue()
    types = {".mp4": "video/mp4", ".webm": "video/webm"}

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            if self.path.startswith("/said/"):
                said.put(unquote(self.path).removeprefix("/said/").split())
            film = self.path == "/video"
            self.send_response(200)
            self.send_header("Content-Type", types[path.suffix] if film else "text/html")
            self.end_headers()
            self.wfile.write(path.read_bytes() if film else PAGE)

        def log_message(self, *arguments):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        address = f"http://127.0.0.1:{server.server_port}/"
        options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}", address]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(["chromium", *options], **quiet) as browser:
            try:
                return said.get(timeout=seconds)
            except queue.Empty:
                return ["silence"]
            finally:
                browser.terminate()
                server.shutdown()


def dom(path, profile):
    """The page of a file after its scripts have run."""
    options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}", "--dump-dom"]
    done = subprocess.run(["chromium", *options, path.as_uri()], capture_output=True, text=True, timeout=60, check=True)
    return done.stdout
