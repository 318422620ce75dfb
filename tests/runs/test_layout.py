from pathlib import Path

from ljn.runs import layout

ROOT = Path(__file__).parents[2]
NAMES = {
    Path(value).name
    for name, value in vars(layout).items()
    if name.isupper() and name not in ("CURVES", "PICTURES")
}


def test_the_names_of_a_run_s_files_stand_once():
    files = [path for folder in ("ljn", "callbacks") for path in (ROOT / folder).rglob("*.py")]
    literal = [
        f"{path.relative_to(ROOT)}: {name}"
        for path in files
        for name in NAMES
        if f'"{name}"' in path.read_text() and path.name != "layout.py"
    ]
    assert len(NAMES) == 13
    assert literal == []


def test_the_configuration_s_places_are_those_of_the_layout(compose_config):
    cfg = compose_config("paths.run_dir=RUN")
    for name, checkpoint in (("best", layout.BEST_CHECKPOINT), ("last", layout.LAST_CHECKPOINT)):
        callback = cfg.callbacks[name]
        assert Path(callback.dirpath) / f"{callback.filename}.ckpt" == Path("RUN") / checkpoint
    assert Path(cfg.callbacks.pictures.directory) == Path("RUN") / layout.PICTURES
    assert Path(cfg.callbacks.errors.directory) == Path("RUN")
    assert Path(cfg.logger.csv.save_dir) / cfg.logger.csv.name == Path("RUN") / Path(layout.CURVES).parts[0]
