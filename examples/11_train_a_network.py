"""Train a small network on rendered frames with PyTorch, and compare it with `bisector`.

`simtest dataset` renders 50 frames of ten colons, `simtest.dataset.learn.Samples` reads them as tensors. A network sees
crops around the highlights of six colons and learns the base's normal there; two colons choose the epoch, the last two
test it. Example 06 shows how a method of your own is run as an estimator. No GPU is needed, but PyTorch:
pip install -e ".[learn]" (docs/start/install.md says how without CUDA).

Picture: a test frame with the network's normals, and all errors. Takes 60 s of processor time.
"""

import copy
import itertools
import subprocess
import sys
from importlib.util import find_spec

import matplotlib.pyplot as plt
import numpy as np
from common import COLOURS, TRUTH, angle_deg, options, save

import simtest
from simtest.dataset import calibration_of, read

chosen = options(__doc__)
if find_spec("torch") is None:
    sys.exit('missing: torch; pip install -e ".[learn]" brings it (docs/start/install.md)')
import torch  # noqa: E402 (not before its absence is known)
from torch import nn  # noqa: E402

from simtest.dataset.learn import Samples  # noqa: E402

SIDE = 32
"""Of a crop, px."""

EPOCHS, BATCH, RATE = 30, 32, 2e-3


# The data ------------------------------------------------------------------------------------------------------------


def crop_of(image: torch.Tensor, x: float, y: float) -> torch.Tensor:
    """Return the crop around a point, over the picture's mean; what lies beyond the border is dark."""
    padded = nn.functional.pad(image / image.mean(), [SIDE // 2] * 4)
    column, row = int(x), int(y)
    return padded[:, row : row + SIDE, column : column + SIDE]


def sightline(calibration: simtest.Calibration, x: float, y: float) -> torch.Tensor:
    """Return x and y of the unit direction that a pixel looks along."""
    return torch.tensor(calibration.camera.unproject(np.array([x, y]))[:2], dtype=torch.float32)


def examples(folder: str, split: str) -> dict[str, torch.Tensor]:
    """Return crops, sightlines and true normals at the visible highlights of a split."""
    rows = []
    for sample in Samples(folder, split, fields=["image", "normal_base"]):
        calibration = calibration_of(sample["meta"])
        for highlight in sample["meta"]["visible_highlights"]:
            x, y = highlight["peak_px"]
            normal = sample["normal_base"][:, int(y), int(x)]
            if normal.isfinite().all():
                rows.append((crop_of(sample["image"], x, y), sightline(calibration, x, y), normal.float()))
    return dict(zip(("crop", "sightline", "normal"), map(torch.stack, zip(*rows, strict=True)), strict=True))


# The network ---------------------------------------------------------------------------------------------------------


class Network(nn.Module):
    """Three convolutions over the crop, two dense layers over their outputs and the sightline."""

    def __init__(self) -> None:
        super().__init__()
        widths, layers = (3, 16, 32, 32), []
        for before, after in itertools.pairwise(widths):
            layers += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.BatchNorm2d(after), nn.ReLU()]
        self.seen = nn.Sequential(*layers, nn.Flatten())
        self.head = nn.Sequential(nn.Linear(32 * (SIDE // 8) ** 2 + 2, 64), nn.ReLU(), nn.Linear(64, 2))

    def forward(self, crop: torch.Tensor, sight: torch.Tensor) -> torch.Tensor:
        """Return unit normals: the direction to the camera, moved by what the network states across it."""
        across = self.head(torch.cat([self.seen(crop), sight], dim=1)) - sight
        return nn.functional.normalize(torch.cat([across, -torch.ones_like(across[:, :1])], dim=1), dim=1)


def loss_of(network: Network, batch: dict[str, torch.Tensor]) -> torch.Tensor:
    """Return the mean of one less the cosine of the angle between stated and true normals."""
    return (1 - (network(batch["crop"], batch["sightline"]) * batch["normal"]).sum(dim=1)).mean()


def trained(taught: dict[str, torch.Tensor], judged: dict[str, torch.Tensor], epochs: int) -> Network:
    """Return the network of the epoch with the smallest loss on the validation split."""
    torch.manual_seed(0)
    network, count = Network(), len(taught["crop"])
    optimiser = torch.optim.AdamW(network.parameters(), RATE, weight_decay=1e-2)
    least, best = float("inf"), network.state_dict()
    for epoch in range(epochs):
        network.train()
        for which in torch.randperm(count).split(BATCH):
            batch = {name: values[which] for name, values in taught.items()}
            if torch.rand(()) < 0.5:  # mirrored: as likely
                batch = {"crop": batch["crop"].flip(-1), **{k: batch[k] * 1 for k in ("sightline", "normal")}}
                batch["sightline"][:, 0] *= -1
                batch["normal"][:, 0] *= -1
            optimiser.zero_grad()
            loss_of(network, batch).backward()
            optimiser.step()
        network.eval()
        with torch.no_grad():
            loss = float(loss_of(network, judged))
        if loss < least:
            least, best = loss, copy.deepcopy(network.state_dict())
        print(f"\repoch {epoch + 1}: loss {loss:.4f}, least {least:.4f}", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    network.load_state_dict(best)
    return network.eval()


# Both methods on colons that the network has not seen ----------------------------------------------------------------

torch.set_num_threads(1)  # several would wait for each other at so small a network
folder = chosen.out / "11_dataset"
few = ["--samples=6", "--set=samples_per_anatomy=2"] if chosen.quick else []
command = [sys.executable, "-m", "simtest", "dataset", "highlights_tiny", f"--out={folder}", *few]
subprocess.run(command, check=True)
network = trained(examples(folder, "train"), examples(folder, "validation"), 2 if chosen.quick else EPOCHS)

errors, arrows = {"bisector": [], "network": []}, []
for record in read(folder, "test", fields=["image", "normal_base"]):
    calibration, arrows = calibration_of(record["meta"]), []
    image = torch.from_numpy(record["image"]).movedim(-1, 0).float() / 255
    for spot in simtest.reconstruct(record["image"], calibration, ["bisector"], isolated=False, target="base"):
        answer = spot.estimates["bisector"]
        if not isinstance(answer, simtest.Estimate):
            continue
        x, y = answer.look_px
        with torch.no_grad():
            (own,) = network(crop_of(image, x, y)[None], sightline(calibration, x, y)[None]).double().numpy()
        truth = record["normal_base"][int(y), int(x)]
        for name, normal in (("bisector", answer.normal), ("network", own)):
            errors[name].append(angle_deg(normal, truth))
            arrows.append((name, (x, y), normal))

figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
left.imshow(record["image"])
for name, colour in (("bisector", COLOURS["bisector"]), ("network", TRUTH)):
    error = np.sort(errors[name])
    print(f"{name}: {len(error)} normals, median error {np.median(error):.1f} deg")
    right.plot(error, np.arange(1, len(error) + 1) / len(error), color=colour, label=name)
    for at, normal in ((at, normal) for which, at, normal in arrows if which == name):
        left.quiver(*at, *normal[:2], color=colour, angles="xy", scale=8, width=0.006)
right.set(xlabel="error of the base's normal, deg", ylabel="share of the normals below", xlim=(0, 40), ylim=(0, 1))
right.legend(loc="lower right")
left.set(xticks=[], yticks=[], xlabel="normals of the base, seen from the camera")
save(figure, chosen.out / "11_train_a_network.jpg")
