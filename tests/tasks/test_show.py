from ljn.tasks.show import show


def test_a_page_of_training_samples_is_drawn(smoke_config, tmp_path):
    metrics = show(smoke_config(tmp_path, "task=show", "task.num_samples=3"))
    assert 50 < metrics["show/initial_mpjpe"] < 400
    assert (tmp_path / "show.png").stat().st_size > 20_000


def test_a_page_of_colour_crops_is_drawn(smoke_config, tmp_path):
    assert show(smoke_config(tmp_path, "task=show", "task.num_samples=3", "data=rgb")) == {}
    assert (tmp_path / "show.png").stat().st_size > 20_000
