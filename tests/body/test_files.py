import builtins
import copyreg
import os
import pickle
import pickletools
import types

import numpy as np
import pytest
import scipy.sparse

from ljn.body import BodyModel, load_body_model, load_body_models
from ljn.body.skeleton import PARENTS

NUM_VERTICES = 30


def smpl_fields(num_betas=10):
    """A small body under the names and types of an official file, with a dense regressor."""
    rng = np.random.default_rng(0)
    regressor = rng.random((24, NUM_VERTICES)) * (rng.random((24, NUM_VERTICES)) < 0.3) + 1e-3
    weights = rng.random((NUM_VERTICES, 24))
    return {
        "v_template": rng.normal(size=(NUM_VERTICES, 3)),
        "shapedirs": rng.normal(size=(NUM_VERTICES, 3, num_betas)),
        "posedirs": rng.normal(size=(NUM_VERTICES, 3, 207)),
        "J_regressor": regressor / regressor.sum(1, keepdims=True),
        "weights": weights / weights.sum(1, keepdims=True),
        "kintree_table": np.array([[2**32 - 1, *PARENTS[1:]], range(24)]),
        "f": rng.integers(NUM_VERTICES, size=(50, 3)).astype(np.uint32),
    }


def embedded_fields():
    with np.load(load_body_model().path) as archive:
        return {key: archive[key] for key in smpl_fields()}


class Ch:
    """Stands for chumpy's class; made without a call, as Python 2 pickled it."""

    __module__ = "chumpy.ch"

    def __init__(self, x):
        self.x = x
        self._dirty_vars = {"x"}
        self._itr = None
        self._depends_on_deps = {}

    def __reduce__(self):
        return copyreg._reconstructor, (type(self), object, None), vars(self)


class Select:
    """Stands for chumpy's class of indexed arrays; pickled by the default protocol 2."""

    __module__ = "chumpy.reordering"

    def __init__(self, a, key):
        chosen = np.arange(a.x.size).reshape(a.x.shape)[key]
        self.a, self.idxs, self.preferred_shape = a, chosen.ravel(), chosen.shape


class OldSparse:
    """Stands for SciPy's sparse matrices where they stood before SciPy 1.8."""

    def __init__(self, matrix):
        vars(self).update(vars(matrix))


OldCsc = type("csc_matrix", (OldSparse,), {"__module__": "scipy.sparse.csc"})
OldCsr = type("csr_matrix", (OldSparse,), {"__module__": "scipy.sparse.csr"})


OLD_MODULES = {
    "builtins": "__builtin__",
    "copyreg": "copy_reg",
    "numpy._core.multiarray": "numpy.core.multiarray",
}


class Python2Pickler(pickle._Pickler):
    """Writes protocol 2 as Python 2 did: text and bytes as strings, modules by their old names."""

    dispatch = pickle._Pickler.dispatch.copy()

    def __init__(self, file):
        super().__init__(file, protocol=2)

    def save_bytes(self, value):
        self.write(pickle.BINSTRING + len(value).to_bytes(4, "little") + value)

    def save_text(self, value):
        self.save_bytes(value.encode("latin1"))

    def save_global(self, value, name=None):
        module = OLD_MODULES.get(value.__module__, value.__module__)
        self.write(f"c{module}\n{value.__name__}\n".encode())
        self.memoize(value)

    dispatch[bytes] = save_bytes
    dispatch[str] = save_text
    dispatch[type] = save_global
    dispatch[types.FunctionType] = save_global


def write_official_pickle(path, fields):
    """Writes a body as the official files are: chumpy shapes, a sparse regressor, extra entries."""
    official = {
        **fields,
        "shapedirs": Ch(np.asarray(fields["shapedirs"], np.float64)),
        "J_regressor": OldCsc(scipy.sparse.csc_matrix(fields["J_regressor"].astype(np.float64))),
        "posedirs": np.asfortranarray(fields["posedirs"]),
        "bs_style": "lbs",
        "J": Ch(np.zeros((24, 3))),
        "pose_training_info": {"gender": "f", "scale": np.float64(1.5), "names": np.array(["a", "bc"])},
    }
    return write_python2(path, official)


def write_python2(path, content):
    with open(path, "wb") as file:
        Python2Pickler(file).dump(content)
    return path


def write_pickle(path, content, protocol=2):
    path.write_bytes(pickle.dumps(content, protocol=protocol))
    return path


def write_npz(path, fields):
    np.savez_compressed(path, **fields)
    return path


def write(path, fields):
    return {".npz": write_npz, ".pkl": write_pickle}[path.suffix](path, fields)


def globals_named(data):
    return {argument for opcode, argument, _ in pickletools.genops(data) if opcode.name == "GLOBAL"}


def test_the_embedded_body_is_complete_and_read_only():
    model = load_body_model()
    assert model.posedirs.shape == (6890, 3, 207)
    assert (model.faces.dtype, model.weights.dtype, model.gender) == (np.int64, np.float32, "neutral")
    with pytest.raises(ValueError, match="read-only"):
        model.weights[0] = 0


def test_npz_and_all_forms_of_pickle_give_the_same_body_and_hash(tmp_path):
    fields = embedded_fields()
    official = write_official_pickle(tmp_path / "official.pkl", fields)
    assert {
        "chumpy.ch Ch", "scipy.sparse.csc csc_matrix", "copy_reg _reconstructor", "__builtin__ set",
        "numpy.core.multiarray _reconstruct", "numpy.core.multiarray scalar", "numpy dtype",
    } <= globals_named(official.read_bytes())  # fmt: skip
    expected = load_body_model()
    for path in (official, write_npz(tmp_path / "body.npz", fields)):
        model = load_body_model(path, "male")
        assert model.hash == expected.hash
        assert (model.path, model.gender) == (path, "male")
        for name in ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "faces"):
            assert np.array_equal(getattr(model, name), getattr(expected, name)), name


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize(
    "sparse", [np.asarray, *(getattr(scipy.sparse, f"{form}_matrix") for form in ("csc", "csr", "coo"))]
)
def test_plain_arrays_and_sparse_matrices_load_from_every_protocol(tmp_path, protocol, sparse):
    fields = smpl_fields()
    expected = load_body_model(write_npz(tmp_path / "body.npz", fields))
    fields["J_regressor"] = sparse(fields["J_regressor"])
    assert load_body_model(write_pickle(tmp_path / "body.pkl", fields, protocol)).hash == expected.hash


def test_chumpy_selections_and_old_csr_load(tmp_path):
    fields = smpl_fields(num_betas=12)
    expected = load_body_model(write_npz(tmp_path / "body.npz", fields))
    fields["shapedirs"] = Select(Ch(fields["shapedirs"]), np.s_[:, :, :10])
    fields["J_regressor"] = OldCsr(scipy.sparse.csr_matrix(fields["J_regressor"]))
    write_python2(tmp_path / "body.pkl", fields)
    assert load_body_model(tmp_path / "body.pkl").hash == expected.hash


def test_big_endian_and_single_precision_arrays_give_the_same_hash(tmp_path):
    fields = {
        key: value.astype(np.float32) if value.dtype.kind == "f" else value
        for key, value in smpl_fields().items()
    }
    swapped = {key: value.astype(value.dtype.newbyteorder(">")) for key, value in fields.items()}
    paths = write_npz(tmp_path / "a.npz", fields), write_pickle(tmp_path / "b.pkl", swapped)
    assert len({load_body_model(path).hash for path in paths}) == 1


def test_the_hash_tells_bodies_apart_and_does_not_change_between_versions():
    fields = smpl_fields()
    arrays = {key: np.round(fields[key], 2) for key in ("v_template", "shapedirs", "posedirs")}
    fixed = {
        "J_regressor": np.eye(24, NUM_VERTICES),
        "weights": np.eye(NUM_VERTICES, 24) + (np.arange(NUM_VERTICES) >= 24)[:, None] / 24,
        "faces": np.array([[0, 1, 2]]),
    }
    model = BodyModel(**arrays, **fixed)
    arrays["v_template"][3, 1] += 0.01
    assert BodyModel(**arrays, **fixed).hash != model.hash
    flat = {key: np.zeros_like(value) for key, value in arrays.items()}
    assert BodyModel(**flat, **fixed).hash == "991f67504fcb2ef3"


def test_more_than_ten_shape_components_are_cut(tmp_path):
    fields = smpl_fields(num_betas=300)
    model = load_body_model(write_npz(tmp_path / "body.npz", fields))
    assert np.array_equal(model.shapedirs, fields["shapedirs"][:, :, :10].astype(np.float32))


# --- Pickles that try to do harm ---


class Call:
    """Asks the unpickler to call a function."""

    def __init__(self, function, *args):
        self.call = function, args

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize(
    ("function", "argument", "name"),
    [
        (os.system, "touch {}", r"(posix|nt)\.system"),
        (builtins.eval, "open({!r}, 'w')", r"(builtins|__builtin__)\.eval"),
        (builtins.getattr, "{}", r"(builtins|__builtin__)\.getattr"),
        (np.save, "{}", r"numpy\.save"),
        (np.memmap, "{}", r"numpy.*\.memmap"),
    ],
)
def test_a_pickle_that_names_a_function_is_refused_and_nothing_runs(
    tmp_path, protocol, function, argument, name
):
    marker = tmp_path / "marker"
    fields = {**smpl_fields(), "bs_style": Call(function, argument.format(str(marker)))}
    path = write_pickle(tmp_path / "evil.pkl", fields, protocol)
    with pytest.raises(ValueError, match=rf"evil\.pkl: names {name}, .*may not be a SMPL model"):
        load_body_model(path)
    assert not marker.exists()


@pytest.mark.parametrize(
    ("stream", "name"),
    [
        (b"cljn.body.files\nload_body_model\n.", r"ljn\.body\.files\.load_body_model"),
        (b"cljn.body.files\n_Record\n.", r"ljn\.body\.files\._Record"),
        (b"cbuiltins\nobject.__subclasses__\n.", r"builtins\.object\.__subclasses__"),
        (b"\x80\x04\x8c\x05numpy\x8c\x0endarray.tofile\x93.", r"numpy\.ndarray\.tofile"),
        (b"(ios\nsystem\n.", r"os\.system"),
        (b"(cos\nsystem\no.", r"os\.system"),
        (b"cchumpyevil\nCh\n.", r"chumpyevil\.Ch"),
        (b"cscipy.sparseevil\ncsc_matrix\n.", r"scipy\.sparseevil\.csc_matrix"),
        (b"cscipy.optimize\nroot\n.", r"scipy\.optimize\.root"),
    ],
)
def test_no_way_of_naming_a_global_leads_round_the_list(tmp_path, stream, name):
    (tmp_path / "evil.pkl").write_bytes(stream)
    with pytest.raises(ValueError, match=f"names {name}, which a SMPL model never needs"):
        load_body_model(tmp_path / "evil.pkl")


class Built:
    """Makes an object by a call and then sets its state."""

    def __init__(self, call, state):
        self.call, self.state = call, state

    def __reduce__(self):
        return (*self.call.call, self.state)


# A dtype whose pickled state says that raw bytes are Python objects.
OBJECTS = Built(Call(np.dtype, "V8", False, True), (3, "|", None, ("a",), {"a": (np.dtype("O"), 0)}, 8, 1, 0))
RECONSTRUCT = np.zeros(1).__reduce__()[0]
SCALAR = np.float64(1).__reduce__()[0]
EMPTY = Call(RECONSTRUCT, np.ndarray, (0,), b"b")
TERABYTES = 10**13


@pytest.mark.parametrize(
    "value",
    [
        Call(RECONSTRUCT, np.ndarray, (TERABYTES,), b"b"),
        Call(np.ndarray, (TERABYTES,)),
        Call(bytearray, TERABYTES),
        Call(SCALAR, np.dtype("O"), pickle.dumps(Call(os.abort))),
        Built(EMPTY, (1, (TERABYTES,), np.dtype("f8"), False, b"")),
        Built(EMPTY, (1, (4,), np.dtype("O"), False, [1, 2, 3, 4])),
        Built(EMPTY, (1, (10**9, "a" * 100), np.dtype("f8"), False, b"")),
        Built(EMPTY, (1, (1,), OBJECTS, False, b"\x01" * 8)),
        Call(copyreg._reconstructor, dict, object, None),
        Call(copyreg._reconstructor, list, list, [1]),
    ],
)
def test_allowed_names_with_evil_arguments_do_nothing(tmp_path, value):
    path = write_pickle(tmp_path / "evil.pkl", {**smpl_fields(), "weights": value})
    with pytest.raises(ValueError, match=r"evil\.pkl: (cannot be read|weights should be an array)"):
        load_body_model(path)


@pytest.mark.parametrize(
    "state",
    [b"}(S'__setstate__'\nNS'args'\nNu", b"N}S'__setstate__'\nNs\x86"],
    ids=["attributes", "slots"],
)
@pytest.mark.parametrize("name", ["chumpy.ch\nCh", "numpy\ndtype", "_codecs\nencode", "builtins\ndict"])
def test_a_pickle_cannot_change_the_classes_that_stand_for_its_names(tmp_path, name, state):
    (tmp_path / "evil.pkl").write_bytes(b"c" + name.encode() + b"\n" + state + b"b.")
    with pytest.raises(ValueError, match="cannot be read"):
        load_body_model(tmp_path / "evil.pkl")
    fields = {**smpl_fields(), "shapedirs": Ch(smpl_fields()["shapedirs"])}
    load_body_model(write_python2(tmp_path / "good.pkl", fields))


def test_a_record_keeps_a_state_that_names_its_class(tmp_path):
    sneaky = Ch(np.zeros((NUM_VERTICES, 24)))
    sneaky.__dict__["__class__"] = dict
    write_python2(tmp_path / "evil.pkl", {**smpl_fields(), "weights": sneaky})
    with pytest.raises(ValueError, match="rows of weights should each sum to 1"):
        load_body_model(tmp_path / "evil.pkl")


@pytest.mark.parametrize(
    "changes",
    [
        {"_shape": (10**6, 10**7)},
        {"_shape": (-24, -NUM_VERTICES)},
        {"indptr": np.array([0, 10**12] + [10**12] * 29)},
        {"indices": np.full(24 * NUM_VERTICES, -1)},
        {"indices": np.full(24 * NUM_VERTICES, 24)},
        {"data": "ab"},
    ],
)
def test_a_forged_sparse_matrix_is_refused_without_being_made(tmp_path, changes):
    fields = smpl_fields()
    matrix = OldCsc(scipy.sparse.csc_matrix(fields["J_regressor"]))
    vars(matrix).update(changes)
    write_python2(tmp_path / "evil.pkl", {**fields, "J_regressor": matrix})
    with pytest.raises(ValueError, match=r"evil\.pkl: (cannot be read|.*sum to 1|J_regressor should)"):
        load_body_model(tmp_path / "evil.pkl")


def test_chumpy_arrays_of_many_levels_are_refused(tmp_path):
    loop = Ch(None)
    loop.x = loop
    tower = Select(Ch(np.zeros(3)), np.s_[:])
    for _ in range(40):  # 2^40 selections
        below, tower = tower, Select(Ch(np.zeros(3)), np.s_[:])
        tower.a = tower.idxs = below
    for shapedirs in (loop, tower):
        write_python2(tmp_path / "evil.pkl", {**smpl_fields(), "shapedirs": shapedirs})
        with pytest.raises(ValueError, match="shapedirs made from arrays in more than 5 levels"):
            load_body_model(tmp_path / "evil.pkl")


def test_a_huge_memo_number_is_refused(tmp_path):
    (tmp_path / "evil.pkl").write_bytes(b"}r" + (2**31 - 1).to_bytes(4, "little") + b".")
    with pytest.raises(ValueError, match="memo number"):
        load_body_model(tmp_path / "evil.pkl")


# --- Files that are damaged, missing or something else ---


@pytest.mark.parametrize("kept", [0.0, 0.5, 0.999])
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_a_truncated_file_is_called_damaged(tmp_path, suffix, kept):
    path = tmp_path / f"body{suffix}"
    write(path, smpl_fields())
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data))])
    with pytest.raises(ValueError, match=rf"body\{suffix}: cannot be read .*damaged"):
        load_body_model(path)


def test_what_numpy_saves_of_an_official_dict_is_the_same_body(tmp_path):
    fields = smpl_fields()
    expected = load_body_model(write_npz(tmp_path / "plain.npz", fields))
    sparse = {**fields, "J_regressor": scipy.sparse.csc_matrix(fields["J_regressor"]), "bs_style": "lbs"}
    np.savez(tmp_path / "entries.npz", **sparse)
    np.savez(tmp_path / "dict.npz", sparse)
    np.save(tmp_path / "dict.npy", sparse, allow_pickle=True)
    for name in ("entries.npz", "dict.npz", "dict.npy"):
        assert load_body_model(tmp_path / name).hash == expected.hash, name


@pytest.mark.parametrize("root", [-1, 2**32 - 1, 2**64 - 1])
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_the_root_s_parent_is_minus_one_in_any_type(tmp_path, suffix, root):
    fields = smpl_fields()
    kind = np.int64 if root < 0 else np.uint64
    table = fields["kintree_table"].astype(kind)
    table[0, 0] = root
    load_body_model(write(tmp_path / f"body{suffix}", {**fields, "kintree_table": table}))


@pytest.mark.parametrize("suffix", [".npz", ".npy"])
def test_python_objects_in_an_archive_are_refused(tmp_path, suffix):
    evil = {**smpl_fields(), "weights": Call(os.abort)}
    path = tmp_path / f"body{suffix}"
    (np.savez if suffix == ".npz" else np.save)(path, evil, allow_pickle=True)
    with pytest.raises(ValueError, match=r"names .*abort, which a SMPL model never needs"):
        load_body_model(path)
    np.savez(tmp_path / "body.npz", **{**smpl_fields(), "weights": np.array([{}], object)})
    with pytest.raises(
        ValueError, match=r"weights should be an array, a chumpy array or a sparse matrix|damaged"
    ):
        load_body_model(tmp_path / "body.npz")


def test_a_gender_that_is_not_embedded_is_refused_with_those_that_are(tmp_path, monkeypatch):
    write_npz(tmp_path / "neutral.npz", smpl_fields())
    monkeypatch.setattr("ljn.body.files._DATA_DIR", tmp_path)
    assert load_body_model().path == tmp_path / "neutral.npz"
    with pytest.raises(FileNotFoundError, match="no male body is embedded, only: neutral"):
        load_body_model(gender="male")


def test_an_unknown_gender_file_or_type_of_file_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no body model file .*none\.pkl.*embedded body"):
        load_body_model(tmp_path / "none.pkl")
    with pytest.raises(ValueError, match="gender: expected one of female, male, neutral, got 'm'"):
        load_body_model(gender="m")
    (tmp_path / "body.mat").touch()
    with pytest.raises(ValueError, match=r"should be a \.npz, \.npy or \.pkl file"):
        load_body_model(tmp_path / "body.mat")


def with_value(array, index, value):
    array = array.copy()
    array[index] = value
    return array


@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
@pytest.mark.parametrize(
    ("key", "change", "message"),
    [
        ("v_template", lambda a: a[:, :2], r"v_template should have shape \(30, 3\), got \(30, 2\)"),
        ("v_template", lambda a: with_value(a, (3, 1), np.nan), "v_template should be finite"),
        ("v_template", lambda a: a.astype("U8"), "real numbers, got dtype <U8|no plain numbers"),
        ("shapedirs", lambda a: a[:, :, :9], r"shapedirs should have shape \(V, 3, 10\) or.*\(30, 3, 9\)"),
        ("posedirs", lambda a: a[:, :, :9], r"posedirs should have shape \(30, 3, 207\), got \(30, 3, 9\)"),
        ("J_regressor", lambda a: a.T, r"J_regressor should have shape \(24, 30\), got \(30, 24\)"),
        ("J_regressor", lambda a: 1.01 * a, "rows of J_regressor should each sum to 1, got sums from 1.01"),
        ("weights", lambda a: with_value(a, 5, 0.0), "rows of weights should each sum to 1, got sums from 0"),
        ("f", lambda a: a + 1, "faces should index the 30 vertices, got indices from 0 to 30"),
        ("f", lambda a: a.astype(np.int64) - 1, "faces should index the 30 vertices, got indices from -1"),
        ("kintree_table", lambda a: with_value(a, (0, 5), 1), "kintree_table should .* begin with"),
        ("kintree_table", lambda a: a[:, :22], r"kintree_table should have .* got shape \(2, 22\)"),
    ],
)  # fmt: skip
def test_a_wrong_array_is_named_with_what_was_expected(tmp_path, suffix, key, change, message):
    fields = smpl_fields()
    fields[key] = change(fields[key])
    path = tmp_path / f"body{suffix}"
    write(path, fields)
    with pytest.raises(ValueError, match=rf"body\{suffix}: .*({message})"):
        load_body_model(path)
    fields = smpl_fields()
    del fields["posedirs"]
    with pytest.raises(ValueError, match="missing: posedirs"):
        load_body_model(write(path, fields))


def test_a_pickle_of_something_else_is_refused(tmp_path):
    with pytest.raises(ValueError, match="should hold a dict, got list"):
        load_body_model(write_pickle(tmp_path / "list.pkl", [1, 2]))
    with pytest.raises(ValueError, match="weights should be an array"):
        load_body_model(write_pickle(tmp_path / "text.pkl", {**smpl_fields(), "weights": "none"}))


# Bodies of several genders


@pytest.mark.parametrize(
    ("gender", "name"),
    [
        ("female", "SMPL_FEMALE.npz"),
        ("male", "male.NPZ"),
        ("female", "basicModel_f_lbs_10_207_0_v1.0.0.npz"),
        ("neutral", "basicmodel_neutral_lbs_10_207_0_v1.1.0.npz"),
    ],
)
def test_a_folder_gives_each_gender_its_file(gender, name, tmp_path):
    embedded = load_body_model(gender=gender)
    (tmp_path / name).write_bytes(embedded.path.read_bytes())
    (tmp_path / "readme.txt").touch()
    (body,) = load_body_models(tmp_path, [gender])
    assert (body.hash, body.gender) == (embedded.hash, gender)


def test_bad_files_of_bodies_are_named(tmp_path):
    file = load_body_model(gender="male").path
    with pytest.raises(ValueError, match=r"holds one body, but bodies of female, male .*body\.genders"):
        load_body_models(file, ["female", "male"])
    with pytest.raises(FileNotFoundError, match=r"missing\.npz"):
        load_body_models(tmp_path / "missing.npz", ["female", "male"])
    (tmp_path / "male.npz").write_bytes(file.read_bytes())
    with pytest.raises(
        FileNotFoundError, match=r"no body of gender female .*SMPL_FEMALE\.pkl.*There is: male\.npz"
    ):
        load_body_models(tmp_path, ["male", "female"])
    (tmp_path / "SMPL_MALE.npz").write_bytes(file.read_bytes())
    with pytest.raises(ValueError, match=r"several bodies of gender male .*SMPL_MALE\.npz, male\.npz"):
        load_body_models(tmp_path, ["male"])
    with pytest.raises(ValueError, match="expected one of female, male, neutral, got 'child'"):
        load_body_models(None, ["child"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: 100 * v, "should be in metres.*centimetres or millimetres"),
        (lambda v: 1000 * v, "should be in metres"),
        (lambda v: v[:, [0, 2, 1]] * [1, -1, 1], "should stand along y.*z up"),
    ],
)
def test_a_body_in_another_unit_or_with_z_up_is_refused(change, message, tmp_path):
    fields = embedded_fields()
    np.savez(tmp_path / "body.npz", **{**fields, "v_template": change(fields["v_template"].astype(float))})
    with pytest.raises(ValueError, match=message):
        load_body_model(tmp_path / "body.npz")


# The official files, and SMPL's relatives


@pytest.mark.parametrize(
    ("folder", "names"),
    [
        ("", ("basicModel_f_lbs_10_207_0_v1.0.0", "basicmodel_m_lbs_10_207_0_v1.0.0")),
        ("smpl/models", ("basicmodel_f_lbs_10_207_0_v1.1.0", "basicmodel_m_lbs_10_207_0_v1.1.0")),
        (
            "SMPL_python_v.1.1.0/smpl/models",
            ("basicmodel_f_lbs_10_207_0_v1.1.0", "basicmodel_m_lbs_10_207_0_v1.1.0"),
        ),
        ("smpl", ("SMPL_FEMALE", "SMPL_MALE")),
    ],
)
def test_official_archives_are_found_as_they_unpack(folder, names, tmp_path):
    (tmp_path / folder).mkdir(parents=True, exist_ok=True)
    (tmp_path / "smplh").mkdir()
    (tmp_path / "smplh" / "SMPLH_FEMALE.npz").touch()
    for name in names:
        write(tmp_path / folder / f"{name}.pkl", smpl_fields())
    female, male = load_body_models(tmp_path, ["female", "male"])
    assert (female.path.stem, male.path.stem) == names
    with pytest.raises(
        FileNotFoundError, match=r"no body of gender neutral .*basicmodel_neutral_.*into one folder"
    ):
        load_body_models(tmp_path, ["neutral"])


def test_without_the_official_files_it_is_said_where_they_are_and_where_to_put_them(tmp_path):
    with pytest.raises(FileNotFoundError) as caught:
        load_body_models(tmp_path / "smpl", ["female", "male"])
    for words in (
        "body.path",
        "smpl.is.tue.mpg.de",
        "registration",
        "body=smpl body.path=FOLDER",
        "embedded",
    ):
        assert words in str(caught.value)


@pytest.mark.parametrize(
    ("joints", "vertices", "name"),
    [(52, 6890, r"SMPL\+H"), (55, 10475, "SMPL-X"), (16, 778, "MANO"), (5, 5023, "FLAME")],
)
@pytest.mark.parametrize("suffix", [".npz", ".pkl"])
def test_relatives_of_smpl_are_named(joints, vertices, name, suffix, tmp_path):
    fields = {
        "v_template": np.zeros((vertices, 3)),
        "kintree_table": np.zeros((2, joints), np.int64),
        "J_regressor": np.zeros((joints, vertices)),
        "hands_componentsl": np.zeros((45, 45)),
    }
    write(tmp_path / f"body{suffix}", fields)
    message = rf"this is a {name} file \({joints} joints, {vertices} vertices\); expected SMPL's 24 joints"
    with pytest.raises(ValueError, match=message):
        load_body_model(tmp_path / f"body{suffix}")


def damaged(content, rng):
    """Bytes of which some are changed, cut out, doubled or moved; most keep their places."""
    content = bytearray(content)
    # The pickle's own words stand between the arrays' numbers, mostly at the two ends.
    ends = 3000
    for _ in range(rng.integers(1, 6)):
        at = rng.integers(len(content)) if rng.random() < 0.3 else rng.integers(-ends, ends) % len(content)
        length = int(rng.integers(1, 9))
        kind = rng.integers(5)
        if kind < 2:
            content[at] = rng.integers(256)
        elif kind == 2:
            del content[at : at + length]
        elif kind == 3:
            content[at:at] = content[at : at + length]
        else:
            other = int(rng.integers(ends)) % len(content)
            content[at : at + length] = content[other : other + length]
    return bytes(content[: int(rng.integers(1, len(content)))] if rng.random() < 0.05 else content)


@pytest.mark.slow
def test_thousands_of_damaged_bodies_are_read_or_refused(tmp_path):
    fields = smpl_fields()
    whole = [
        write_official_pickle(tmp_path / "official.pkl", fields),
        write_pickle(tmp_path / "protocol_5.pkl", fields, protocol=5),
        write_npz(tmp_path / "arrays.npz", fields),
    ]
    for path in whole:
        rng = np.random.default_rng(0)
        content, num_read, messages = path.read_bytes(), 0, []
        for _ in range(2000):
            path.write_bytes(damaged(content, rng))
            try:
                body = load_body_model(path)
            except ValueError as error:
                messages.append(str(error))
            else:
                assert all(np.isfinite(getattr(body, name)).all() for name in ("v_template", "weights"))
                num_read += 1
        print(f"{path.name}: {num_read} read, {len(messages)} refused")
        assert all(str(path) in message for message in messages)
        assert len(messages) > 100
        assert num_read  # few archives: their checksums tell
