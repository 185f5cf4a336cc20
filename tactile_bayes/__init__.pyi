from tactile_bayes import errors as errors
from tactile_bayes.actions.record import record as record
from tactile_bayes.api.comparing import Comparison as Comparison
from tactile_bayes.api.comparing import compare as compare
from tactile_bayes.api.diagnosing import Diagnosis as Diagnosis
from tactile_bayes.api.diagnosing import diagnose as diagnose
from tactile_bayes.api.estimates import ExportedFiles as ExportedFiles
from tactile_bayes.api.estimates import estimate as estimate
from tactile_bayes.api.estimates import exam_report as exam_report
from tactile_bayes.api.estimates import export as export
from tactile_bayes.api.estimates import pool as pool
from tactile_bayes.api.maps import Map as Map
from tactile_bayes.api.maps import build_map as build_map
from tactile_bayes.api.maps import check as check
from tactile_bayes.api.maps import demo_map as demo_map
from tactile_bayes.api.maps import demo_scan as demo_scan
from tactile_bayes.api.maps import map_of as map_of
from tactile_bayes.api.maps import read_map as read_map
from tactile_bayes.api.maps import read_scan as read_scan
from tactile_bayes.api.maps import scan as scan
from tactile_bayes.api.maps import simulate as simulate
from tactile_bayes.api.pooled import PooledSize as PooledSize
from tactile_bayes.api.repeatability import calibrate_repeatability as calibrate_repeatability
from tactile_bayes.api.size_calibration import calibrate_size as calibrate_size
from tactile_bayes.api.sized import SizeEstimate as SizeEstimate
from tactile_bayes.api.trials import TrialPlan as TrialPlan
from tactile_bayes.api.trials import TrialResult as TrialResult
from tactile_bayes.api.trials import plan as plan
from tactile_bayes.api.trials import validate as validate
from tactile_bayes.campaigns.campaign import CampaignResult as CampaignResult
from tactile_bayes.campaigns.campaign import campaign as campaign
from tactile_bayes.inference.draws import Draws as Draws

__version__: str
__all__: list[str]
