"""An unsupervised mapper after DeepMapping, best-buddies registration in place of its Chamfer distance."""

from models.deep_mapping import DeepMapping as DeepMapping
from models.deep_mapping import MappingOutput as MappingOutput
from models.deep_mapping import corrected_poses as corrected_poses
from models.free_poses import FreePoses as FreePoses
from models.free_space import sample_free_space as sample_free_space
from models.localisation import LNet as LNet
from models.occupancy import MNet as MNet
from models.registration_terms import REGISTRATION_TERMS as REGISTRATION_TERMS
from models.registration_terms import TermSettings as TermSettings
from models.registration_terms import registration_term as registration_term
from models.scan_batch import Localisation as Localisation
from models.scan_batch import RegistrationTerm as RegistrationTerm
from models.scan_batch import ScanBatch as ScanBatch
