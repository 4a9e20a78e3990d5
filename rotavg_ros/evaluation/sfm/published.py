"""Figures published in the NeuRoRA paper (Purkait, Chin & Reid, ECCV 2020), for the columns next to ours.

Degrees and seconds as printed there; its machine, its graphs. Facts of a publication, read in its tables 1 to 4.
"""

from __future__ import annotations

from typing import NamedTuple


class Published(NamedTuple):
    """Mean and median error, degrees, and seconds of CPU time; averages where there are several graphs."""

    mean_deg: float
    median_deg: float
    cpu_seconds: float


class Scene(NamedTuple):
    """A real photo collection: 1DSfM's, Arts Quad or San Francisco.

    Attributes:
        cameras, with_truth: number of cameras, and of those with ground truth, to which the errors refer.
        pairs_percent: share of all pairs that have an edge.
        figures: by method.
    """

    cameras: int
    with_truth: int
    pairs_percent: float
    figures: dict[str, Published]


class Configuration(NamedTuple):
    """A kind of graph, as table 3 states it.

    Attributes:
        cameras: of every graph.
        pairs_percent: share of all pairs that have an edge.
        noise_deg: largest σ of the noise, degrees.
        outliers_percent: share of outliers among the edges.
        planar: planar motion; otherwise in space.
    """

    cameras: int
    pairs_percent: float
    noise_deg: float
    outliers_percent: float
    planar: bool

    def __str__(self) -> str:
        place = "planar" if self.planar else "in space"
        return f"{self.cameras}, {self.pairs_percent:g} %, {self.noise_deg:g}°, {self.outliers_percent:g} %, {place}"


class Robustness(NamedTuple):
    """Networks trained on one kind of graph and tested on another.

    Attributes:
        varied: what differs.
        trained, tested: kinds of graphs.
        neurora, chatterjee: figures; None where the paper has none.
    """

    varied: str
    trained: Configuration
    tested: Configuration
    neurora: Published
    chatterjee: Published | None


# Table 1: 120 test graphs of the recipe in its text, by our names of the methods.
SYNTHETIC: dict[str, Published] = {
    "chatterjee": Published(2.17, 1.25, 5.38),
    "weiszfeld": Published(3.35, 1.02, 50.92),
    "arrigoni": Published(2.92, 1.42, 8.2),
    "wang": Published(2.77, 1.4, 9.75),
    "cleannet-spt-paper+chatterjee": Published(2.11, 1.26, 5.41),
    "cleannet-spt-paper+weiszfeld": Published(1.74, 1.01, 50.36),
    "cleannet-spt-paper+wang": Published(2.77, 1.4, 9.86),
    "neurora-paper": Published(1.45, 0.74, 0.21),
    "neurora-v2-paper": Published(1.3, 0.68, 0.3),
    "cleannet-spt-paper": Published(2.93, 1.47, 0.11),
    "spt-finenet-paper": Published(3.0, 1.57, 0.11),
    "spt-finenet-paper+chatterjee": Published(2.12, 1.26, 5.41),
    "spt-finenet-paper+weiszfeld": Published(1.78, 1.01, 50.36),
    "spt-finenet-paper+wang": Published(2.78, 1.4, 9.86),
    "neurora-paper+chatterjee": Published(2.11, 1.26, 5.51),
    "neurora-paper+weiszfeld": Published(1.73, 1.01, 50.46),
}

# Table 2.
REAL: dict[str, Scene] = {
    "Alamo": Scene(
        627,
        577,
        49.5,
        {
            "chatterjee": Published(4.2, 1.1, 20.5),
            "weiszfeld": Published(4.9, 1.4, 84.0),
            "arrigoni": Published(6.2, 1.6, 2.7),
            "wang": Published(5.3, 1.4, 20.6),
            "neurora-paper": Published(4.9, 1.2, 2.2),
        },
    ),
    "EllisIsland": Scene(
        247,
        227,
        66.8,
        {
            "chatterjee": Published(2.8, 0.5, 2.5),
            "weiszfeld": Published(4.4, 1.0, 8.9),
            "arrigoni": Published(3.9, 1.2, 0.2),
            "wang": Published(3.6, 1.1, 2.6),
            "neurora-paper": Published(2.6, 0.6, 0.4),
        },
    ),
    "GendrmMarkt": Scene(
        742,
        677,
        17.5,
        {
            "chatterjee": Published(37.6, 7.7, 11.1),
            "weiszfeld": Published(29.4, 9.6, 53.7),
            "arrigoni": Published(41.6, 13.3, 8.9),
            "wang": Published(32.6, 6.1, 12.5),
            "neurora-paper": Published(4.5, 2.9, 0.5),
        },
    ),
    "MadridMetrop": Scene(
        394,
        341,
        30.7,
        {
            "chatterjee": Published(6.9, 1.2, 3.2),
            "weiszfeld": Published(7.5, 2.7, 14.5),
            "arrigoni": Published(6.0, 1.7, 0.9),
            "wang": Published(5.0, 1.4, 3.6),
            "neurora-paper": Published(2.5, 1.1, 0.2),
        },
    ),
    "MontrealNotre": Scene(
        474,
        450,
        46.8,
        {
            "chatterjee": Published(1.5, 0.5, 9.1),
            "weiszfeld": Published(2.1, 0.7, 41.5),
            "arrigoni": Published(4.8, 0.9, 2.9),
            "wang": Published(2.0, 0.8, 10.1),
            "neurora-paper": Published(1.2, 0.6, 1.0),
        },
    ),
    "NYCLibrary": Scene(
        376,
        332,
        29.3,
        {
            "chatterjee": Published(3.0, 1.3, 4.8),
            "weiszfeld": Published(3.8, 2.1, 14.4),
            "arrigoni": Published(3.9, 1.5, 1.4),
            "wang": Published(2.9, 1.4, 3.2),
            "neurora-paper": Published(1.9, 1.1, 0.2),
        },
    ),
    "NotreDame": Scene(
        553,
        553,
        68.1,
        {
            "chatterjee": Published(3.5, 0.6, 23.3),
            "weiszfeld": Published(4.7, 0.8, 80.8),
            "arrigoni": Published(3.9, 1.0, 4.2),
            "wang": Published(3.5, 0.9, 19.5),
            "neurora-paper": Published(1.6, 0.6, 2.0),
        },
    ),
    "PiazzaDelP": Scene(
        354,
        338,
        39.5,
        {
            "chatterjee": Published(4.0, 0.8, 3.3),
            "weiszfeld": Published(4.8, 1.3, 16.7),
            "arrigoni": Published(10.8, 1.2, 0.6),
            "wang": Published(6.2, 1.1, 3.6),
            "neurora-paper": Published(3.0, 0.7, 0.4),
        },
    ),
    "Piccadilly": Scene(
        2508,
        2152,
        10.2,
        {
            "chatterjee": Published(6.9, 2.9, 449.0),
            "weiszfeld": Published(26.4, 7.5, 1200.0),
            "arrigoni": Published(22.0, 9.7, 43.7),
            "wang": Published(10.1, 3.9, 118.1),
            "neurora-paper": Published(4.7, 1.9, 5.9),
        },
    ),
    "RomanForum": Scene(
        1134,
        1084,
        10.9,
        {
            "chatterjee": Published(3.1, 1.5, 20.2),
            "weiszfeld": Published(4.8, 1.8, 115.0),
            "arrigoni": Published(13.2, 8.2, 16.8),
            "wang": Published(4.6, 3.5, 19.6),
            "neurora-paper": Published(2.3, 1.3, 1.3),
        },
    ),
    "TowerLondon": Scene(
        508,
        472,
        18.5,
        {
            "chatterjee": Published(3.9, 2.4, 1.9),
            "weiszfeld": Published(4.7, 2.9, 17.1),
            "arrigoni": Published(4.6, 1.8, 3.9),
            "wang": Published(2.9, 1.5, 3.6),
            "neurora-paper": Published(2.6, 1.4, 0.3),
        },
    ),
    "Trafalgar": Scene(
        5433,
        5058,
        4.6,
        {
            "chatterjee": Published(3.5, 2.0, 858.4),
            "weiszfeld": Published(15.6, 11.3, 5520.0),
            "arrigoni": Published(48.6, 13.2, 167.4),
            "wang": Published(17.2, 16.0, 319.2),
            "neurora-paper": Published(5.3, 2.2, 15.5),
        },
    ),
    "UnionSquare": Scene(
        930,
        789,
        5.9,
        {
            "chatterjee": Published(9.3, 3.9, 6.8),
            "weiszfeld": Published(40.9, 10.3, 42.8),
            "arrigoni": Published(9.2, 4.4, 12.1),
            "wang": Published(6.8, 3.2, 4.1),
            "neurora-paper": Published(5.9, 2.0, 0.6),
        },
    ),
    "ViennaCath": Scene(
        918,
        836,
        24.6,
        {
            "chatterjee": Published(8.2, 1.2, 48.1),
            "weiszfeld": Published(11.7, 1.9, 158.3),
            "arrigoni": Published(19.3, 2.39, 6.0),
            "wang": Published(10.1, 1.8, 25.7),
            "neurora-paper": Published(3.9, 1.5, 2.1),
        },
    ),
    "Yorkminster": Scene(
        458,
        437,
        26.5,
        {
            "chatterjee": Published(3.5, 1.6, 4.0),
            "weiszfeld": Published(5.7, 2.0, 32.0),
            "arrigoni": Published(4.5, 1.6, 2.5),
            "wang": Published(3.5, 1.3, 4.9),
            "neurora-paper": Published(2.5, 0.9, 0.4),
        },
    ),
    "Acropolis": Scene(
        463,
        463,
        10.7,
        {
            "chatterjee": Published(1.1, 0.7, 1.5),
            "weiszfeld": Published(0.6, 0.3, 15.0),
            "arrigoni": Published(2.7, 1.7, 3.2),
            "wang": Published(2.4, 1.6, 1.7),
            "neurora-paper": Published(0.8, 0.5, 0.2),
        },
    ),
    "ArtsQuad": Scene(
        5530,
        4978,
        1.4,
        {
            "chatterjee": Published(4.8, 3.5, 116.1),
            "weiszfeld": Published(34.4, 23.1, 1920.0),
            "arrigoni": Published(35.2, 15.8, 189.4),
            "wang": Published(6.0, 3.2, 73.9),
            "neurora-paper": Published(27.5, 7.3, 5.0),
        },
    ),
    "SanFran": Scene(
        7866,
        7866,
        0.3,
        {
            "chatterjee": Published(3.6, 3.4, 15.2),
            "weiszfeld": Published(18.8, 16.4, 1320.0),
            "arrigoni": Published(66.8, 43.9, 354.7),
            "wang": Published(89.2, 75.5, 27.2),
            "neurora-paper": Published(17.6, 12.6, 2.6),
        },
    ),
    "TNotreDame": Scene(
        715,
        715,
        25.3,
        {
            "chatterjee": Published(1.0, 0.4, 10.6),
            "weiszfeld": Published(1.4, 0.6, 72.5),
            "arrigoni": Published(2.4, 0.9, 5.7),
            "wang": Published(1.7, 0.8, 14.8),
            "neurora-paper": Published(1.7, 0.7, 1.4),
        },
    ),
}

# Table 3: what networks are trained on, then its rows.
_DENSE = Configuration(1000, 25.0, 30.0, 10.0, True)
_SMALL = Configuration(250, 25.0, 30.0, 10.0, True)
_SPARSE = Configuration(1000, 2.5, 30.0, 10.0, True)
_QUIET = Configuration(1000, 25.0, 10.0, 5.0, True)
_IN_SPACE = Configuration(1000, 25.0, 30.0, 10.0, False)
ROBUSTNESS: tuple[Robustness, ...] = (
    Robustness("cameras", _DENSE, _SMALL, Published(1.1, 0.9, 0.1), Published(1.8, 1.7, 0.3)),
    Robustness(
        "cameras",
        _SMALL,
        Configuration(5000, 2.5, 30.0, 10.0, True),
        Published(1.1, 1.0, 4.9),
        Published(1.4, 1.3, 720.0),
    ),
    Robustness("cameras", _SMALL, Configuration(10000, 2.5, 30.0, 10.0, True), Published(0.7, 0.6, 18.7), None),
    Robustness("cameras", _SMALL, Configuration(25000, 2.5, 30.0, 10.0, True), Published(0.6, 0.5, 142.6), None),
    Robustness("edges", _DENSE, _SPARSE, Published(2.4, 2.1, 0.1), Published(3.0, 2.8, 3.3)),
    Robustness("edges", _SPARSE, _DENSE, Published(0.5, 0.4, 2.5), Published(0.9, 0.8, 43.2)),
    Robustness("noise and outliers", _DENSE, _QUIET, Published(0.4, 0.3, 2.5), Published(0.3, 0.3, 31.6)),
    Robustness("noise and outliers", _QUIET, _DENSE, Published(0.6, 0.5, 2.5), Published(0.9, 0.8, 43.2)),
    Robustness("planar", _DENSE, _IN_SPACE, Published(2.2, 1.6, 2.5), Published(0.9, 0.8, 26.3)),
    Robustness("planar", _IN_SPACE, _DENSE, Published(0.9, 0.7, 2.5), Published(0.9, 0.8, 26.3)),
)

# Table 4: a ScanNet scene by VisualSFM, about 1401 cameras and 5.8 % of the pairs.
SCANNET: dict[str, Published] = {
    "chatterjee": Published(12.08, 7.8, 2.01),
    "weiszfeld": Published(22.93, 12.3, 82.92),
    "arrigoni": Published(32.44, 18.26, 30.2),
    "wang": Published(18.68, 8.53, 6.52),
    "cleannet-spt-paper": Published(11.37, 7.41, 0.45),
    "neurora-paper": Published(11.02, 6.92, 0.92),
}

# Seconds on a GPU: a synthetic graph, and the ScanNet scene.
GPU_SECONDS = (0.0016, 0.028)
