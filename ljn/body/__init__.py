"""The parametric body: its skeleton, its model files and the SMPL layer."""

from ljn.body.files import GENDERS, BodyModel, load_body_model, load_body_models
from ljn.body.smpl import SMPL, SMPLOutput

__all__ = ["GENDERS", "SMPL", "BodyModel", "SMPLOutput", "load_body_model", "load_body_models"]
