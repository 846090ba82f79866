"""Chromium for tests: it plays a video and reports what it saw, or shows a page and is driven by the test."""

import base64
import contextlib
import http.server
import itertools
import json
import queue
import subprocess
import threading
import time
import urllib.request
from urllib.parse import unquote

import cv2
import numpy as np
from websockets.sync.client import connect

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
    """What Chromium reports once the video is over: "ended", width, height, and red, green, blue of the middle pixel.

    Virtual time would be over before a video is, so a local server waits for the report.
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
        with _chromium(profile, "--disable-gpu", address):
            try:
                return said.get(timeout=seconds)
            except queue.Empty:
                return ["silence"]
            finally:
                server.shutdown()


@contextlib.contextmanager
def _chromium(profile, *options):
    command = ["chromium", "--headless", "--no-sandbox", f"--user-data-dir={profile}", *options]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as browser:
        try:
            yield
        finally:
            browser.terminate()


@contextlib.contextmanager
def opened(address, profile, size=(800, 500)):
    """A function that opens the address in another tab and returns it, driven through Chromium's DevTools protocol."""
    options = ["--remote-debugging-port=0", "--enable-unsafe-swiftshader", "--use-angle=swiftshader"]
    # With it, headless Chromium sometimes gives a page that is loaded again an empty localStorage.
    options.append("--disable-features=RenderDocument")
    with _chromium(profile, *options, "about:blank"):
        port = awaited(lambda: (profile / "DevToolsActivePort").read_text().split()[0])
        with contextlib.ExitStack() as stack:

            def tab():
                request = urllib.request.Request(f"http://127.0.0.1:{port}/json/new", method="PUT")
                with urllib.request.urlopen(request) as answer:
                    socket_address = json.load(answer)["webSocketDebuggerUrl"]
                return Page(stack.enter_context(connect(socket_address, max_size=None)), address, size)

            yield tab


def awaited(question, seconds=60):
    """The first true answer to `question`, asked repeatedly; errors of files and indices are no answers."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        with contextlib.suppress(OSError, IndexError):
            if answer := question():
                return answer
        time.sleep(0.1)
    raise TimeoutError(f"no answer in {seconds} seconds")


def result_of(page, script, folder):
    """What `script`, the body of a function run once the page has loaded, returns."""
    with opened(page.as_uri(), folder / "profile") as tab:
        shown = tab()
        awaited(lambda: shown.says("location.href !== 'about:blank' && document.readyState === 'complete'"))
        return shown.says(f"(() => {{ {script} }})()")


class Page:
    """A page of controls, each in a row with the label that it is known by."""

    CONTROL = """(name => {
      const label = [...document.querySelectorAll("label")].find(label => label.innerText === name);
      let row = label;
      while (!row.querySelector("input")) row = row.parentElement;
      return [...row.querySelectorAll("input")].filter(input => input.type !== "hidden").at(-1);
    })"""

    def __init__(self, socket, address, size):
        self._socket, self._numbers, self._events = socket, itertools.count(), []
        for domain in ("Runtime", "Network", "Log", "Page"):
            self._call(f"{domain}.enable")
        width, height = size
        self._call("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)
        self._call("Page.navigate", url=address)

    def says(self, script):
        """The value of an expression."""
        answer = self._call("Runtime.evaluate", expression=script, returnByValue=True)
        return answer["result"].get("value")

    def text(self):
        """All that can be read."""
        return self.says("document.body?.innerText ?? ''")

    def value(self, name):
        """What a control shows."""
        return self.says(f"{self.CONTROL}({json.dumps(name)}).value")

    def enter(self, name, text):
        """Type into a control."""
        self.says(f"(control => {{ control.focus(); control.select() }})({self.CONTROL}({json.dumps(name)}))")
        self._call("Input.insertText", text=text)
        for kind in ("keyDown", "keyUp"):
            self._call("Input.dispatchKeyEvent", type=kind, key="Enter", code="Enter", windowsVirtualKeyCode=13)

    def click(self, name):
        """Click a control."""
        self._click(f"{self.CONTROL}({json.dumps(name)})")

    def choose(self, name, option):
        """Choose from a list."""
        self.click(name)
        entry = f'[...document.querySelectorAll("[role=option]")].find(e => e.innerText === {json.dumps(option)})'
        awaited(lambda: self.says(f"!!{entry}"))
        self._click(entry)

    def wheel(self, position, distance):
        """Turn the mouse wheel."""
        x, y = position
        self._call("Input.dispatchMouseEvent", type="mouseWheel", x=x, y=y, deltaX=0, deltaY=distance)

    def drag(self, start, end, modifiers=0):
        """Press the mouse's left button at one point, let go of it at another; 8 is for the Shift key."""
        for kind, (x, y) in (("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)):
            arguments = {"type": kind, "x": x, "y": y, "modifiers": modifiers, "clickCount": 1}
            self._call("Input.dispatchMouseEvent", **arguments, button="left", buttons=int(kind != "mouseReleased"))

    def touch(self, *positions):
        """Move each finger through its positions."""
        kinds = ["touchStart", *["touchMove"] * (len(positions[0]) - 1)]
        for kind, points in zip(kinds, zip(*positions, strict=True), strict=True):
            points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(points)]
            self._call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
        self._call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def press(self, key):
        """Press a key where the focus is."""
        text = {"text": key} if len(key) == 1 else {}
        self._call("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self._call("Input.dispatchKeyEvent", type="keyUp", key=key)

    def picture(self):
        """A screenshot, RGB."""
        data = base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]

    def complaints(self):
        """Errors on the console, and exceptions."""
        calls = [e["params"] for e in self._events if e["method"] == "Runtime.consoleAPICalled"]
        logged = [e["params"]["entry"] for e in self._events if e["method"] == "Log.entryAdded"]
        thrown = [e["params"] for e in self._events if e["method"] == "Runtime.exceptionThrown"]
        return [x for x in calls if x["type"] == "error"] + [x for x in logged if x["level"] == "error"] + thrown

    def addresses(self):
        """What it has asked the network for."""
        asked = [e["params"]["request"]["url"] for e in self._events if e["method"] == "Network.requestWillBeSent"]
        return asked + [e["params"]["url"] for e in self._events if e["method"] == "Network.webSocketCreated"]

    def _click(self, element):
        self.says(f'{element}.scrollIntoView({{block: "nearest"}})')
        box = self.says(f"(box => [box.x + box.width / 2, box.y + box.height / 2])({element}.getBoundingClientRect())")
        for kind in ("mousePressed", "mouseReleased"):
            self._call("Input.dispatchMouseEvent", type=kind, x=box[0], y=box[1], button="left", clickCount=1)

    def _call(self, method, **parameters):
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            message = json.loads(self._socket.recv(timeout=60))
            if message.get("id") == number:
                assert "exceptionDetails" not in message.get("result", {"exceptionDetails": 0}), message
                return message["result"]
            self._events.append(message)
