import errno
import os
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from cdpipe.core.errors import InputError
from cdpipe.descriptors import describe_scan, describe_scans, load_descriptors, relative_yaws_rad, save_descriptors
from cdpipe.descriptors.describe import _BATCH, insert_rows
from cdpipe.descriptors.network import DIMENSIONS, make_untrained_network, yaw_correlation
from cdpipe.descriptors.range_image import COLUMNS, ELEVATION_RAD, ROWS, range_image
from cdpipe.model.config import DescriptorConfig, MapConfig
from cdpipe.model.types import DescriptorSet, PosedScan, Spheres
from cdpipe.training.fit import FitConfig, fit
from cdpipe.training.scan_training import PlaceData, PlaceTask, _mirror, _partners, _place_loss, evaluate


def test_a_point_falls_where_its_angles_say() -> None:
    # straight up the x axis: middle row, first column; 90 deg to the left: a quarter of the columns further
    image = range_image(np.array([[5.0, 1e-6, -1e-6], [1e-6, 3.0, -1e-6], [4.0, 1e-6, -1e-6]]))
    assert image[ROWS // 2, 0] == pytest.approx(4.0)  # the nearer of two
    assert image[ROWS // 2, COLUMNS // 4 - 1] == pytest.approx(3.0)
    assert (image > 0).sum() == 2
    steep = ELEVATION_RAD * 1.05
    assert not range_image(np.array([[np.cos(steep), 0.0, np.sin(steep)]])).any()
    assert range_image(np.zeros((0, 3))).shape == (ROWS, COLUMNS)


def test_a_turned_sensor_keeps_q_and_shifts_w() -> None:
    network = make_untrained_network()
    images = torch.rand(2, ROWS, COLUMNS, generator=torch.Generator().manual_seed(1)) * 20
    turned = torch.roll(images, 2 * COLUMNS // DIMENSIONS * 5, dims=2)
    with torch.inference_mode():
        (q, w), (q_turned, w_turned) = network(images), network(turned)
    np.testing.assert_allclose(q, q_turned, atol=1e-5)
    np.testing.assert_allclose(torch.roll(w, 10, dims=1), w_turned, atol=1e-5)
    # the scene moved counter-clockwise, so the sensor turned clockwise
    assert np.rad2deg(relative_yaws_rad(w[0].numpy(), w_turned[0].numpy(), n=1)) == pytest.approx(-56.25, abs=1e-3)


def test_correlation_equals_its_definition() -> None:
    a, b = torch.randn(2, 1, DIMENSIONS, generator=torch.Generator().manual_seed(2))
    slow = [float((a[0] * torch.roll(b[0], s)).sum()) for s in range(DIMENSIONS)]
    np.testing.assert_allclose(yaw_correlation(a, b)[0], slow, atol=1e-5)


class _Source:
    name = "test"
    odom_T_sensor = np.stack([np.eye(4)] * 3)

    def scan(self, index: int) -> PosedScan:
        points = np.random.default_rng(index).normal(size=(500, 3)) * (8, 3, 1)
        return PosedScan(index, points, np.eye(4), np.zeros(500, dtype=np.int64), np.arange(500, dtype=np.int32))


@pytest.mark.parametrize("method", ["3deg", "untrained"])
def test_descriptors_are_unit_vectors_and_survive_the_disk(tmp_path: Path, method: str) -> None:
    config = DescriptorConfig(method=method)
    made = describe_scans(_Source(), np.array([0, 2]), config)
    np.testing.assert_allclose(np.linalg.norm(made.q, axis=1), 1.0, atol=1e-5)
    q, w = describe_scan(_Source().scan(2), config)
    np.testing.assert_allclose(made.q[1], q, atol=1e-6)
    np.testing.assert_allclose(made.w[1], w, atol=1e-6)
    poses = _Source.odom_T_sensor
    assert load_descriptors(tmp_path, config, poses, MapConfig()) is None
    path = save_descriptors(tmp_path, made, poses, MapConfig())
    assert load_descriptors(tmp_path, config, poses + 1e-9, MapConfig()) is None  # recorded anew
    assert load_descriptors(tmp_path, config, poses, MapConfig(airborne="drop")) is None  # without its dust
    read = load_descriptors(tmp_path, config, poses, MapConfig())
    assert read is not None
    np.testing.assert_array_equal(read.q, made.q)
    np.testing.assert_array_equal(read.w, made.w)
    assert (read.name, read.checkpoint) == (method, made.checkpoint)
    np.savez(path, q=made.q)
    with pytest.raises(InputError, match=r"damaged"):
        load_descriptors(tmp_path, config, poses, MapConfig())


def test_descriptors_of_other_settings_are_replaced_with_a_warning(tmp_path: Path) -> None:
    poses, plain, dust = _Source.odom_T_sensor, MapConfig(), MapConfig(airborne="drop")
    made = describe_scans(_Source(), np.array([0, 2]), DescriptorConfig())
    with_spheres = replace(made, spheres=np.zeros((2, 64), np.float32))

    def save(descriptors: DescriptorSet, map_config: MapConfig, *, warns: bool) -> None:
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            path = save_descriptors(tmp_path, descriptors, poses, map_config)
        assert [str(each.message) for each in told] == warns * [
            f"{path}: replaces the descriptors of other settings: with those, the session is described anew"
        ]

    save(made, plain, warns=False)
    save(made, plain, warns=False)
    save(with_spheres, plain, warns=False)  # they serve the settings of before, too
    save(made, plain, warns=True)
    save(with_spheres, dust, warns=True)
    save(with_spheres, MapConfig(airborne="drop", voxel_m=0.1), warns=True)
    save(replace(made, checkpoint="other"), dust, warns=True)
    save(replace(made, keyframe_scans=np.array([0, 1])), dust, warns=True)
    (tmp_path / "descriptors" / "3deg.npz").write_bytes(b"")
    save(made, plain, warns=False)
    poses = poses + 1e-9
    save(with_spheres, dust, warns=False)  # what was recorded anew is described anew anyway


def test_descriptors_that_do_not_fit_on_the_disk_leave_no_part_of_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = describe_scans(_Source(), np.array([0, 2]), DescriptorConfig())

    def full(path: Path, **_: object) -> None:
        path.write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(InputError, match="No space left on device"):
        save_descriptors(tmp_path, made, _Source.odom_T_sensor, MapConfig())
    assert list((tmp_path / "descriptors").iterdir()) == []


def test_stored_spheres_are_used_with_their_weights_precision_and_map_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    poses, config = _Source.odom_T_sensor, DescriptorConfig()
    spheres = np.linspace(-1, 1, 128, dtype=np.float32).reshape(2, 64)
    made = replace(describe_scans(_Source(), np.array([0, 2]), config), spheres=spheres)
    save_descriptors(tmp_path, made, poses, MapConfig())

    def read(of: DescriptorConfig, map_config: MapConfig) -> Spheres | None:
        found = load_descriptors(tmp_path, of, poses, map_config)
        assert found is not None
        return found.spheres

    np.testing.assert_array_equal(read(config, MapConfig()), spheres)
    assert read(config, MapConfig(voxel_m=0.3)) is None
    assert read(DescriptorConfig(precision="int8"), MapConfig()) is None
    monkeypatch.setattr("cdpipe.descriptors.describe.sphere_digest", lambda *_: "other")
    assert read(config, MapConfig()) is None


def _rooms(n_tunnels: int) -> PlaceData:
    """Places of a made-up tunnel: an image that slides with x, seen twice from 0.3 m apart."""
    images, positions, tunnels, sessions = [], [], [], []
    for tunnel in range(n_tunnels):
        walls = np.random.default_rng(tunnel).uniform(2, 12, size=(ROWS, COLUMNS * 3))
        for session in (0, 1):
            for place in range(8):
                start = place * 60 + 3 * session
                images.append(walls[:, start : start + COLUMNS])
                positions.append((place * 10.0 + 0.3 * session, 0.0, 0.0))
                tunnels.append(tunnel)
                sessions.append(session)
    n = len(images)
    return PlaceData(
        np.array(images, np.float32), np.array(positions), np.zeros(n), np.array(tunnels), np.array(sessions)
    )


def _subset(data: PlaceData, mask: np.ndarray) -> PlaceData:
    return PlaceData(**{name: getattr(data, name)[mask] for name in PlaceData.__dataclass_fields__})


def _fitted(folder: Path, data: PlaceData, n_steps: int) -> tuple[torch.nn.Module, list[dict[str, float]]]:
    """Train on a few rooms; returns the network and the losses of every step."""
    losses: list[dict[str, float]] = []
    folder.mkdir()
    task = PlaceTask(make_untrained_network(1), data, data, seed=1)
    config = FitConfig(seed=1, steps=n_steps, validate_every=n_steps)
    fit(task, config, folder, "", lambda _, parts: losses.append(dict(parts)), lambda _: None)
    return task.network, losses


def test_training_lowers_both_losses(tmp_path: Path) -> None:
    _, losses = _fitted(tmp_path / "one", _rooms(3), 40)
    for part, share in (("place", 0.1), ("yaw", 0.5)):
        assert np.mean([step[part] for step in losses[35:40]]) < share * losses[0][part]


@pytest.mark.parametrize("n_steps", [4, pytest.param(40, marks=pytest.mark.soak)])
def test_training_repeats_by_seed(tmp_path: Path, n_steps: int) -> None:
    data = _rooms(3)
    one, other = (_fitted(tmp_path / name, data, n_steps)[0] for name in ("one", "other"))
    assert not all(
        torch.equal(*both) for both in zip(one.parameters(), make_untrained_network(1).parameters(), strict=True)
    )
    for mine, its in zip(one.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(mine, its, rtol=0, atol=0)


def test_a_mirrored_image_is_that_of_the_mirrored_scan() -> None:
    points = np.random.default_rng(3).normal(size=(400, 3)) * (8, 3, 1)
    image, mirror_image = (torch.from_numpy(range_image(points * (1, side, 1)))[None] for side in (1, -1))
    both, headings_rad = _mirror(image.repeat(2, 1, 1), np.array([0.5, 0.5]), np.array([False, True]))
    torch.testing.assert_close(both[0], image[0])
    torch.testing.assert_close(both[1], mirror_image[0])
    np.testing.assert_array_equal(headings_rad, [0.5, -0.5])


def test_place_loss_counts_hard_negatives_of_other_places_alone() -> None:
    anchor, near, far = torch.eye(3)
    q = torch.stack([anchor, far, anchor, near])  # anchors 0 and 1, their positives 2 and 3
    apart = torch.tensor([[False, True, False, True], [True, False, True, False]])
    # 0 has its positive at 1 and negatives at 0; 1 has its positive and its negatives at 0
    likeness = 1 / 0.03
    first, second = np.log1p(2 * np.exp(-likeness)), np.log(3.0)
    assert float(_place_loss(q, apart)) == pytest.approx((first + second) / 2)
    # what is no negative does not count, however like it looks
    assert float(_place_loss(torch.stack([anchor, anchor, anchor, anchor]), torch.zeros(2, 4, dtype=torch.bool))) == 0.0


def test_places_of_one_session_alone_train_nothing() -> None:
    data = _rooms(2)
    with pytest.raises(InputError, match="both sessions drive through"):
        PlaceTask(make_untrained_network(0), _subset(data, data.sessions == 0), data, seed=0)
    # a line 2.5 m aside, keyframes every metre: the nearest one and its neighbours, no farther than 3 m
    along_m, aside_m = np.tile(np.arange(10.0), 2), np.repeat([0.0, 2.5], 10)
    aside = PlaceData(
        np.zeros((20, ROWS, COLUMNS), np.float32),
        np.column_stack([along_m, aside_m, np.zeros(20)]),
        np.zeros(20),
        np.zeros(20, np.int64),
        np.repeat([0, 1], 10),
    )
    np.testing.assert_array_equal(_partners(aside)[5], [14, 15, 16])
    # the after session drove half of the way: there each has its counterpart, beyond nobody has
    halved = _subset(data, (data.sessions == 0) | (data.positions[:, 0] < 35))
    for index, partners in enumerate(_partners(halved)):
        assert len(partners) == (halved.positions[index, 0] < 35)
        assert (halved.sessions[partners] != halved.sessions[index]).all()
        assert (np.abs(halved.positions[partners, 0] - halved.positions[index, 0]) < 1).all()


def test_scores_of_a_perfect_and_a_blind_network() -> None:
    data = _rooms(2)

    class Perfect(torch.nn.Module):
        """Looks the place up by its image, turned or not."""

        def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            spectrum = torch.fft.rfft(images.mean(dim=1)).abs()
            w = images.reshape(len(images), ROWS, DIMENSIONS, -1).mean(dim=(1, 3))
            return torch.nn.functional.normalize(spectrum - spectrum.mean(dim=1, keepdim=True), dim=1), w

    perfect = evaluate(Perfect(), data)
    assert perfect["recall_at_1"] > 0.9
    assert perfect["yaw_error_deg"] < 6.0

    class Blind(torch.nn.Module):
        def forward(self, images: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            return torch.ones(len(images), 4) / 2, torch.zeros(len(images), DIMENSIONS)

    # every before keyframe looks alike, the first is taken: 1 of 8 places is right
    assert evaluate(Blind(), data)["recall_at_1"] == pytest.approx(1 / 8)


def test_some_keyframes_first_and_the_others_later_are_all_of_them() -> None:
    config, scans, rows = DescriptorConfig(method="solid"), np.array([0, 3, 4, 7]), np.array([0, 2])
    whole = describe_scans(_Source(), scans, config)
    first = insert_rows(describe_scans(_Source(), scans[rows], config), rows, scans)
    np.testing.assert_array_equal(first.q[rows], whole.q[rows])
    assert not first.q[[1, 3]].any() and first.w is not None and not first.w[[1, 3]].any()
    others = np.array([1, 3])
    both = insert_rows(describe_scans(_Source(), scans[others], config), others, scans, first)
    np.testing.assert_array_equal(both.q, whole.q)
    np.testing.assert_array_equal(both.w, whole.w)
    np.testing.assert_array_equal(both.keyframe_scans, scans)
    assert (both.name, both.checkpoint) == (whole.name, whole.checkpoint)
    assert not first.q[[1, 3]].any()  # the known ones are not overwritten


def test_batches_change_no_vector() -> None:
    scans = np.arange(2 * _BATCH + 9)  # two batches, and a smaller one
    made = describe_scans(_Source(), scans, DescriptorConfig())
    for index in (0, _BATCH, len(scans) - 1):
        q, w = describe_scan(_Source().scan(index), DescriptorConfig())
        np.testing.assert_allclose(made.q[index], q, atol=1e-5)
        assert made.w is not None
        np.testing.assert_allclose(made.w[index], w, atol=1e-5)
