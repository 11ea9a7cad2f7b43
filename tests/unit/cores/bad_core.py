"""A core that breaks down as its first argument says, one fault an answer; it needs Python alone.

Further arguments make it a frame core, or spare the first answers.
"""

import json
import os
import signal
import struct
import subprocess
import sys
import time

FAULTS = sys.argv[1].split(",") if len(sys.argv) > 1 else ["none"]
FAULT = FAULTS[0]
KIND = "frame" if "--frame" in sys.argv else "patch"
SPARED = next((int(word[8:]) for word in sys.argv if word.startswith("--spared")), 0)
SIZES = {"<f8": 8, "<f4": 4, "<u2": 2, "|u1": 1, "<i4": 4, "|b1": 1}
HANG_S = 600


def send(header, raw=b""):
    content = header if isinstance(header, bytes) else json.dumps(header).encode() + b"\n"
    sys.stdout.buffer.write(content + raw)
    sys.stdout.buffer.flush()


def receive():
    line = sys.stdin.buffer.readline()
    if not line:
        return None
    header = json.loads(line)
    arrays = {}
    for entry in header.get("arrays", []):
        count = SIZES[entry["dtype"]]
        for length in entry["shape"]:
            count *= length
        arrays[entry["name"]] = sys.stdin.buffer.read(count)
    return header, arrays


def hang():
    time.sleep(HANG_S)
    os._exit(0)


def grandchild():
    """Start a child that holds the pipes open, and tell its number on standard error."""
    child = subprocess.Popen([sys.executable, "-S", "-c", f"import time; time.sleep({HANG_S})", *sys.argv])
    print(f"grandchild {child.pid}", file=sys.stderr, flush=True)


def hello():
    message = {
        "type": "hello", "protocol": 1, "name": "bad core", "version": "0.1", "kind": KIND,
        "arrays": ["values" if KIND == "patch" else "intensity"],
    }  # fmt: skip
    changed = {
        "protocol": {"protocol": 2}, "kind": {"kind": "film"}, "arrays_unknown": {"arrays": ["truth"]},
        "level": {"isophotes": [1.5]}, "no_name": {"name": ""}, "transport": {"transport": "smoke"},
    }  # fmt: skip
    return message | changed.get(FAULT, {})


def good(number):
    looks = {"look_px": [320.0, 240.0]}
    estimate = {"normal": [0.0, 0.0, -1.0], **looks}
    if KIND == "frame":
        return {"type": "estimates", "id": number, "estimates": [estimate]}
    return {"type": "estimate", "id": number, **estimate}


def changed(number, fault):
    """Return a good answer with the fault's fields."""
    fields = {
        "nan": {"normal": [float("nan")] * 3}, "zero": {"normal": [0, 0, 0]}, "long": {"normal": [0, 0, -2]},
        "away": {"normal": [0, 0, 1]}, "text": {"normal": ["0", "0", "-1"]}, "two": {"normal": [0, -1]},
        "no_look": {"look_px": None}, "indefinite": {"covariance": [[1, 0], [0, -1]]},
        "target": {"target": "liver"}, "flags": {"flags": ["a b"]}, "candidates": {"candidates": [[0, 0.6, -0.8]]},
        "infinite_covariance": {"covariance": [[1e999, 0], [0, 1]]},
        "basis": {"covariance": [[1, 0], [0, 1]], "basis": [[1, 0, 0], [1, 0, 0]]},
    }[fault]  # fmt: skip
    answer = good(number)
    if KIND == "frame":
        answer["estimates"][0].update(fields)
    return answer | (fields if KIND == "patch" else {})


def wire(number):
    """Send a message that breaks the protocol; return whether the fault is one of these."""
    listed = {"type": "estimate", "id": number, "normal": [0, 0, -1]}
    array = {"name": "look_px", "dtype": "<f8", "shape": [2]}
    sent = {
        "garbage_text": b"normal: 0 0 1\n", "garbage_json": b'{"type": "estimate", "id"\n',
        "binary": bytes(range(128, 256)) * 20 + b"\n", "list": b"[1, 2]\n", "deep": b"[" * 100_000 + b"\n",
        "huge_array": {**listed, "arrays": [{**array, "shape": [10**6, 10**6]}]},
        "negative": {**listed, "arrays": [{**array, "shape": [-2]}]},
        "dtype": {**listed, "arrays": [{**array, "dtype": "|O"}]},
        "wrong_shape": {**listed, "arrays": [{**array, "shape": "2"}]},
        "wrong_id": good(number + 7), "unknown_type": {"type": "poem", "id": number},
        "twice": (json.dumps(good(number)) + "\n").encode() * 2,
    }  # fmt: skip
    if FAULT not in sent:
        return False
    send(sent[FAULT], struct.pack("<2d", 1, 2) if FAULT in ("huge_array", "negative", "dtype") else b"")
    return True


def frame_counts(number):
    """Send too few or too many estimates."""
    counts = {"none_found": 0, "too_many": 20_000}
    if FAULT not in counts:
        return False
    one = {"normal": [0, 0, -1], "look_px": [1, 1]}
    send({"type": "estimates", "id": number, "estimates": [one] * counts[FAULT]})
    return True


def half_array(number):
    entry = {"name": "look_px", "dtype": "<f8", "shape": [2]}
    send({"type": "estimate", "id": number, "normal": [0, 0, -1], "arrays": [entry]}, b"\0" * 5)
    hang()


def flood(_):
    while True:
        os.write(1, b"x" * 65536)


def flood_stderr(number):
    for _ in range(200):
        os.write(2, b"warning \x1b[31m\n" * 8192)
    send(good(number))


def leave(_):
    print("no licence for this highlight", file=sys.stderr, flush=True)
    os._exit(3)


ACTIONS = {
    "kill": lambda _: os.kill(os.getpid(), signal.SIGKILL),
    "segfault": lambda _: os.kill(os.getpid(), signal.SIGSEGV),
    "exit": leave,
    "hang": lambda _: hang(),
    "ignores_term": lambda _: hang(),
    "half_line": lambda _: (send(b'{"type": "estimate", "id"'), hang()),
    "half_array": half_array,
    "flood": flood,
    "flood_after": lambda number: (send(good(number)), flood(number)),
    "flood_stderr": flood_stderr,
    "exit_after": lambda number: (send(good(number)), os._exit(0)),
    "closes_stdout": lambda _: (os.close(1), hang()),
    "late": lambda number: (time.sleep(2), send(good(number))),
    "grandchild": lambda _: (grandchild(), os._exit(0)),
}


def break_down(number, fault):
    """Do what the fault says instead of answering."""
    if FAULT in ACTIONS:
        ACTIONS[FAULT](number)
    elif not wire(number) and not frame_counts(number):
        send(changed(number, fault))


def begin():
    """Read the greeting and answer it, or break down before."""
    if FAULT == "exit_at_start":
        print("no such model", file=sys.stderr)
        sys.exit(4)
    if FAULT == "hang_at_start":
        hang()
    if FAULT == "ignores_term":
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)
    receive()
    if FAULT in ("half_hello", "no_hello"):
        send(b'{"type": "hello"' if FAULT == "half_hello" else b"Welcome to the core!\n")
        hang()
    send(hello())
    if FAULT == "exit_after_hello":
        os._exit(5)
    if FAULT in ("closes_stdin", "reads_nothing"):
        if FAULT == "closes_stdin":
            os.close(0)
        hang()


def main():
    begin()
    answered = 0
    while (asked := receive()) is not None:
        if FAULT in ("none", "stays") or answered < SPARED:
            send(good(asked[0]["id"]))
        else:
            break_down(asked[0]["id"], FAULTS[answered % len(FAULTS)])
        answered += 1
    if FAULT == "stays":
        hang()


main()
