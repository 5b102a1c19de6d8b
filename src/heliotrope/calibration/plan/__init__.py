"""Plan measurements: the sun positions and targets that are most informative per heliostat.

`plan_sightings` chooses among the `candidate_sightings` of one heliostat, `plan_each` does so for
several heliostats that share targets, and `plan_campaign` schedules a whole field; `fleets_of`
prepares the heliostats of a plant. `plan_commission` plans the first days of a new field until a
goal is reached. Tables and plots are in `calibration.plan.report`; covariance updates for one more
sighting are in `calibration.plan.gain`.
"""

from heliotrope.calibration.plan.campaign import CalibrationCampaign, Timing, plan_campaign
from heliotrope.calibration.plan.commission import (
    CommissionPlan,
    CommissionTerms,
    plan_commission,
)
from heliotrope.calibration.plan.fleets import Fleet, fleets_of, plan_each
from heliotrope.calibration.plan.joint_terms import JointTerms
from heliotrope.calibration.plan.planning import (
    Aimed,
    CandidateSightings,
    SightingLimits,
    SightingPlan,
    aim_at,
    candidate_sightings,
    plan_sightings,
    sighting_jacobian,
    time_grid,
)
from heliotrope.calibration.plan.receiver_terms import ReceiverTerms

__all__ = [
    "Aimed",
    "CalibrationCampaign",
    "CandidateSightings",
    "CommissionPlan",
    "CommissionTerms",
    "Fleet",
    "JointTerms",
    "ReceiverTerms",
    "SightingLimits",
    "SightingPlan",
    "Timing",
    "aim_at",
    "candidate_sightings",
    "fleets_of",
    "plan_campaign",
    "plan_commission",
    "plan_each",
    "plan_sightings",
    "sighting_jacobian",
    "time_grid",
]
