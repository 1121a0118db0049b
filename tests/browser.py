"""A browser without a window, worked through Chrome's DevTools protocol by its pipe."""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np

PROGRAM = shutil.which("chromium") or shutil.which("google-chrome")
QUIET = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
QUIET += ["--hide-scrollbars", "--remote-debugging-pipe"]

READY = """new Promise(done => {
    const ready = () => document.body?.dataset.ready || /cannot/.test(document.body?.innerText);
    const wait = () => ready() ? done(1) : setTimeout(wait, 50);
    wait();
})"""


class Page:
    """A page that is shown in ``size`` CSS px, on a phone of that many pixels each if ``phone`` is given."""

    def __init__(self, address: str, folder: Path, size: tuple[int, int], phone: float | None = None):
        self.phone = phone is not None
        heard, told = os.pipe(), os.pipe()
        command = [PROGRAM, *QUIET, f"--user-data-dir={folder / 'browser'}", "about:blank"]

        def descriptors() -> None:  # the browser hears on 3 and tells on 4
            ears, mouth = os.dup(heard[0]), os.dup(told[1])
            os.dup2(ears, 3)
            os.dup2(mouth, 4)

        self._process = subprocess.Popen(
            command, close_fds=False, preexec_fn=descriptors, stderr=subprocess.DEVNULL
        )
        os.close(heard[0])
        os.close(told[1])
        self._out, self._in = os.fdopen(heard[1], "wb", 0), os.fdopen(told[0], "rb")
        self._asked, self._session = 0, None
        (target, *_) = (
            each["targetId"]
            for each in self.ask("Target.getTargets")["targetInfos"]
            if each["type"] == "page"
        )
        self._session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        screen = {"width": size[0], "height": size[1], "deviceScaleFactor": phone or 1, "mobile": bool(phone)}
        self.ask("Emulation.setDeviceMetricsOverride", **screen)
        if phone:
            self.ask("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
        self.ask("Page.navigate", url=address)
        self.run(READY)

    def ask(self, method: str, **parameters) -> dict:
        """The browser's answer."""
        self._asked += 1
        question = {"id": self._asked, "method": method, "params": parameters}
        if self._session:
            question["sessionId"] = self._session
        self._out.write(json.dumps(question).encode() + b"\0")
        while True:
            answer = json.loads(self._next())
            if answer.get("id") == self._asked:
                assert "error" not in answer, answer
                return answer["result"]

    def _next(self) -> bytes:
        letters = bytearray()
        while (letter := self._in.read(1)) != b"\0":
            assert letter, "the browser ended"
            letters += letter
        return bytes(letters)

    def run(self, script: str) -> object:
        """The value of a piece of JavaScript, awaited."""
        found = self.ask("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def picture(self) -> np.ndarray:
        """What is seen, RGB in [0, 1]."""
        content = base64.b64decode(self.ask("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR)[..., ::-1] / 255

    def canvas(self) -> np.ndarray:
        """What the page draws, RGB in [0, 1], whatever lies above it."""
        self.run("document.getElementById('panel').style.visibility = 'hidden'")
        picture = self.picture()
        self.run("document.getElementById('panel').style.visibility = ''")
        return picture

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 8) -> None:
        """By mouse."""
        where = np.linspace(start, end, steps + 1)
        self._mouse("mousePressed", where[0])
        for place in where[1:]:
            self._mouse("mouseMoved", place)
        self._mouse("mouseReleased", where[-1])

    def _mouse(self, kind: str, place: np.ndarray) -> None:
        x, y = map(float, place)
        self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def swipe(self, *fingers: tuple[tuple[float, float], tuple[float, float]], steps: int = 8) -> None:
        """Each finger from one place to another, at once."""
        paths = np.array([np.linspace(start, end, steps + 1) for start, end in fingers])
        self._touch("touchStart", paths[:, 0])
        for step in range(1, steps + 1):
            self._touch("touchMove", paths[:, step])
        self._touch("touchEnd", paths[:0, 0])

    def _touch(self, kind: str, places: np.ndarray) -> None:
        points = [{"x": float(x), "y": float(y), "id": number} for number, (x, y) in enumerate(places)]
        self.ask("Input.dispatchTouchEvent", type=kind, touchPoints=points)

    def slider(self, words: str) -> tuple[tuple[float, float], float, float, float]:
        """Of the slider that is called ``words``: its left end and its length, px, its least and greatest
        value."""
        x, y, length, low, high = self.run(
            f"""(() => {{
            const labels = [...document.querySelectorAll("label")];
            const input = labels.find(each => each.innerText.includes("{words}")).querySelector("input");
            const box = input.getBoundingClientRect();
            return [box.left, box.top + box.height / 2, box.width, +input.min, +input.max]; }})()"""
        )
        return (x, y), length, low, high

    def close(self) -> None:
        self._process.kill()
        self._process.wait(20)
        self._out.close()
        self._in.close()
