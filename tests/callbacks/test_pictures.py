from types import SimpleNamespace

import pytest
import torch

from callbacks.pictures import VIEWS, JointView, Pictures
from ljn.body.skeleton import NUM_JOINTS, ROOT
from ljn.metrics import mpjpe_root_aligned


class Drawn(JointView):
    """Keeps what it is to draw."""

    def draw(self, samples, titles, num_columns, module):
        self.samples, self.titles = samples, titles
        return super().draw(samples, titles, num_columns, module)


@pytest.fixture
def draw_extremes(tmp_path, monkeypatch):
    """The page after a test of three samples: those with the best shapes have their roots farthest off."""

    def draw(is_root_relative):
        generator = torch.Generator().manual_seed(0)
        joints = torch.randn(3, NUM_JOINTS, 3, generator=generator)
        pred_joints = joints + torch.tensor([0.01, 0.02, 0.03])[:, None, None]
        pred_joints[:, ROOT] = joints[:, ROOT]
        pred_joints += torch.tensor([2.0, 1.0, 0.0])[:, None, None]
        points = torch.randn(3, 50, 6, generator=generator)
        dataset = SimpleNamespace(__getitems__=lambda indices: {"points": points[indices]})
        trainer = SimpleNamespace(
            is_global_zero=True, loggers=[], test_dataloaders=SimpleNamespace(dataset=dataset)
        )
        module = SimpleNamespace(stage="detector", is_root_relative=is_root_relative)
        batch = {"sample_id": torch.arange(3), "joints": joints}
        view = Drawn()
        monkeypatch.setitem(VIEWS, "detector", view)
        pictures = Pictures(tmp_path, num_samples=1)
        pictures.on_test_batch_end(trainer, module, {"pred_joints": pred_joints}, batch, 0)
        pictures.on_test_end(trainer, module)
        assert (tmp_path / "test_best_median_worst.png").is_file()
        return view, pred_joints, joints

    return draw


def test_joints_are_ranked_and_drawn_where_they_were_predicted(draw_extremes):
    view, pred_joints, _ = draw_extremes(is_root_relative=False)
    assert view.samples["sample_id"].tolist() == [2, 1, 0]
    assert torch.equal(view.samples["pred_joints"], pred_joints[[2, 1, 0]])
    assert all(title.endswith(" mm") for title in view.titles)


def test_root_relative_joints_are_ranked_and_drawn_after_moving_the_roots(draw_extremes):
    view, pred_joints, joints = draw_extremes(is_root_relative=True)
    assert view.samples["sample_id"].tolist() == [0, 1, 2]
    torch.testing.assert_close(
        view.samples["error"], mpjpe_root_aligned(pred_joints, joints), rtol=1e-4, atol=0
    )
    torch.testing.assert_close(view.samples["pred_joints"][:, ROOT], joints[:, ROOT])
    assert view.titles[0] == "best: 17 mm, root-aligned"
