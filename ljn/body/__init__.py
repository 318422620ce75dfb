"""The parametric body: its skeleton, its model files and the SMPL layer."""

from ljn.body.files import GENDERS, BodyModel, load_body_model, load_body_models
from ljn.body.smpl import SMPL, SMPLOutput
from ljn.body.sparse import SparseSMPL

__all__ = ["GENDERS", "SMPL", "BodyModel", "SMPLOutput", "SparseSMPL", "load_body_model", "load_body_models"]
