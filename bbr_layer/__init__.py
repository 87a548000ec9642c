"""Best Buddies Registration of point clouds as a differentiable PyTorch layer."""

from bbr_layer.atomic import atomic_write as atomic_write
from bbr_layer.backward import Autograd as Autograd
from bbr_layer.backward import Detached as Detached
from bbr_layer.backward import Replay as Replay
from bbr_layer.backward import Truncated as Truncated
from bbr_layer.buddies import hard_buddies as hard_buddies
from bbr_layer.buddies import soft_buddies as soft_buddies
from bbr_layer.cloud_writing import write_cloud as write_cloud
from bbr_layer.clouds import Cloud as Cloud
from bbr_layer.clouds import read_cloud as read_cloud
from bbr_layer.clouds import read_scans as read_scans
from bbr_layer.clouds import sample_surface as sample_surface
from bbr_layer.clouds import scan_paths as scan_paths
from bbr_layer.functional import register as register
from bbr_layer.geometry import RigidMotion as RigidMotion
from bbr_layer.geometry import angular_error as angular_error
from bbr_layer.geometry import translation_error as translation_error
from bbr_layer.inner.adam import Adam as Adam
from bbr_layer.inner.charts import EulerAngles as EulerAngles
from bbr_layer.inner.charts import RotationVector as RotationVector
from bbr_layer.inner.schedules import Constant as Constant
from bbr_layer.inner.schedules import Cosine as Cosine
from bbr_layer.inner.schedules import StepDown as StepDown
from bbr_layer.kernels.choice import Backend as Backend
from bbr_layer.kernels.choice import backend as backend
from bbr_layer.layer import BBRLayer as BBRLayer
from bbr_layer.losses import BuddyFilter as BuddyFilter
from bbr_layer.losses import SoftBBS as SoftBBS
from bbr_layer.losses import SoftBD as SoftBD
from bbr_layer.losses import SoftBDNormals as SoftBDNormals
from bbr_layer.normals import estimate_normals as estimate_normals
from bbr_layer.normals import point_spacing as point_spacing
from bbr_layer.pair import CloudPair as CloudPair
from bbr_layer.registration import Registration as Registration
from bbr_layer.registration import Status as Status
from bbr_layer.stage import Stage as Stage
from bbr_layer.temperature import Annealed as Annealed
from bbr_layer.temperature import Learned as Learned
from bbr_layer.temperature import Unrounded as Unrounded
from bbr_layer.trajectories import read_poses as read_poses
from bbr_layer.trajectories import read_poses_kitti as read_poses_kitti
from bbr_layer.trajectories import read_poses_tum as read_poses_tum
from bbr_layer.trajectories import write_poses_kitti as write_poses_kitti
from bbr_layer.trajectories import write_poses_tum as write_poses_tum

__version__ = "0.1.0"
