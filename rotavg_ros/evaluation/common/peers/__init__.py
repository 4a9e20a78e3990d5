"""Independent implementations to compare with: COLMAP's, GTSAM's and Open3D's.

They come with ``pip install pycolmap gtsam open3d`` and are imported only when one of them runs. Each takes a
view-graph and times only its own work: the clock starts when the graph is in the peer's form and stops before its
answer is converted back. Pose-graph methods only get rotation factors, with the precisions that the graph states, since
the others only get rotations; those on poses, in a module of their own, are given deviations.
"""

from rotavg_ros.evaluation.common.peers.colmap_peer import colmap
from rotavg_ros.evaluation.common.peers.gtsam_peers import gnc, isam2_cauchy, isam2_geman_mcclure, isam2_huber, shonan
from rotavg_ros.evaluation.common.peers.gtsam_pose_peers import gnc_on_poses, isam2_on_poses
from rotavg_ros.evaluation.common.peers.open3d_peer import line_process
from rotavg_ros.evaluation.common.peers.running import MissingPeerError, PeerError

__all__ = [
    "MissingPeerError",
    "PeerError",
    "colmap",
    "gnc",
    "gnc_on_poses",
    "isam2_cauchy",
    "isam2_geman_mcclure",
    "isam2_huber",
    "isam2_on_poses",
    "line_process",
    "shonan",
]
