"""Accuracy of floors, walls and doors found from masks.

Run `python benchmarks/found_floors.py SHARDS ... [--homes HOMES ...]`. The shards must hold 3D
ground truth, as those of `prep-front` do. A room counts as mostly seen if at least 90% of its true
floor is shown by some view or lies under the true box of a piece that stands on it. The error of a
wall is the largest distance of its ends from the nearest parallel side of the true floor. `--homes`
gives the folder of each shard folder's houses, for the true doors. The noise of `--noisy` displaces
each pose by 1 cm and 0.5 degrees, and gives a twentieth of the pixels on the edges of masks to the
neighbour.
"""

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import shapely
from tracks import _moved, rooms

from data_prep.front.houses import house_files
from data_prep.front.models import ModelBank
from data_prep.front.recipe import load_recipe
from data_prep.front.rooms import read_house
from sceneprior.core.found_floor import find_floor
from sceneprior.core.shards import RoomGroundTruth, RoomViews
