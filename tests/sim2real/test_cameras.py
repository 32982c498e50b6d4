"""Frame buffers, the capture thread and sets of simultaneous frames; the file, OAK and rendered
cameras."""

import sys
import threading
import time
from datetime import timedelta
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from dlo_gym.exceptions import DeviceError, MissingExtra, RenderingUnavailable
from dlo_gym.geometry.camera import CameraModel
from dlo_gym.rod.boundary import BoundaryPoses
from dlo_gym.scene.builder import default_cameras
from dlo_gym.scene.renderer import SceneRenderer
from sim2real.cameras import frame_buffer, opencv_camera
from sim2real.cameras.camera import CameraSettings, Frame
from sim2real.cameras.capture import DamagedImageError, Shot, StreamCamera
from sim2real.cameras.drivers import make_camera
from sim2real.cameras.frame_buffer import FrameBuffer
from sim2real.cameras.mjpeg_camera import MjpegCamera
from sim2real.cameras.oak_camera import OakCamera, shot_of_packet
from sim2real.cameras.opencv_camera import OpenCVCamera, device_kind
from sim2real.cameras.rendered_camera import RenderedCamera
from sim2real.cameras.synchronisation import newest_match, synchronised

MODEL = CameraModel.looking_at("top", (0, 0, 1), (0, 0, 0), up=(0, 1, 0), width=32, height=24)
IMAGE = np.zeros((24, 32, 3), np.uint8)


def frame(stamp):
    return Frame(IMAGE, stamp, stamp, 0)


def eventually(condition, seconds=5.0):
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "never came true"
        time.sleep(0.005)


class TestFrameBuffer:
    def test_keeps_a_second_and_gives_the_newest(self):
        buffer = FrameBuffer("top", timeout=0.5, clock=lambda: 3.0)
        for i in range(91):
            buffer.add(IMAGE, i / 30 - 0.02, i / 30)
        assert buffer.latest().stamp == pytest.approx(2.98)
        stamps = [each.stamp for each in buffer.frames(-1.0)]
        assert stamps == sorted(stamps)
        assert 1.0 <= stamps[-1] - stamps[0] < 1.1
        assert [each.stamp for each in buffer.frames(2.9)] == [s for s in stamps if s > 2.9]
        assert buffer.frames(2.98) == []
        statistics = buffer.statistics()
        assert statistics.n_frames == 91
        assert statistics.n_dropped == 0
        assert statistics.rate_hz == pytest.approx(30.0)
        assert statistics.delay == pytest.approx(0.02)

    def test_refuses_a_stale_frame_by_name_and_seconds(self):
        now = 10.0
        buffer = FrameBuffer("top", timeout=0.5, clock=lambda: now)
        with pytest.raises(DeviceError, match="'top': no frame yet"):
            buffer.latest()
        buffer.add(IMAGE, 9.9, 10.0)
        now = 10.4
        assert buffer.latest().index == 0
        now = 10.75
        with pytest.raises(DeviceError, match=r"'top': no new frame for 0\.75 s \(limit 0\.5 s\)$"):
            buffer.latest()
        buffer.lost("cable pulled")
        with pytest.raises(DeviceError, match="cable pulled"):
            buffer.latest()

    def test_memory_is_bounded_whatever_the_rate(self):
        buffer = FrameBuffer("top", timeout=0.5, clock=lambda: 0.0)
        for i in range(1000):
            buffer.add(IMAGE, i * 1e-4, i * 1e-4)
        assert len(buffer.frames(-1.0)) == frame_buffer.MAX_BUFFERED

    def test_counts_drops_but_no_outages(self):
        buffer = FrameBuffer("top", timeout=0.5)
        for i in (*range(10), 13, 14):
            buffer.add(IMAGE, i / 20, i / 20)
        assert buffer.statistics().n_dropped == 3
        buffer.lost("unplugged")
        buffer.add(IMAGE, 1.6, 1.6)
        buffer.add(IMAGE, 1.65, 1.65)
        assert buffer.statistics().n_dropped == 3
        for i in range(34, 44):
            buffer.add(IMAGE, i / 20, i / 20)
        buffer.damaged()
        buffer.add(IMAGE, 45 / 20, 45 / 20)
        assert buffer.statistics().n_dropped == 4

    def test_ignores_a_repeated_frame(self):
        buffer = FrameBuffer("top", timeout=0.5)
        buffer.add(IMAGE, 1.0, 1.1)
        buffer.add(IMAGE, 1.0, 1.2)
        buffer.add(IMAGE, 0.9, 1.3)
        assert [each.arrival for each in buffer.frames(0.0)] == [1.1]


class ScriptedSource:
    """Frames at 100 Hz until ``ends`` is set; then what ``end`` does."""

    def __init__(self, image=IMAGE, end=None):
        self.image = image
        self.ends = threading.Event()
        self.end = end
        self.closed = threading.Event()

    def read(self):
        if self.ends.wait(0.01):
            self.end()
        return Shot(self.image, None)

    def interrupt(self):
        pass

    def close(self):
        self.closed.set()


class ScriptedCamera(StreamCamera):
    open_timeout = 0.5

    def __init__(self, connect, **kwargs):
        super().__init__(MODEL, **kwargs)
        self._connect = connect

    def _connect(self):
        raise NotImplementedError


def test_stamp_is_arrival_minus_latency():
    with ScriptedCamera(ScriptedSource, latency=0.04) as camera:
        before = time.monotonic()
        eventually(lambda: camera.latest().arrival > before)
        newest = camera.latest()
    assert newest.arrival - newest.stamp == pytest.approx(0.04)
    assert before < newest.arrival < time.monotonic()


def test_reopens_a_lost_stream_and_is_stale_meanwhile():
    def fail():
        raise OSError("cable pulled")

    plugged = threading.Event()
    plugged.set()
    sources = []

    def connect():
        if not plugged.is_set():
            raise OSError("no such device")
        sources.append(ScriptedSource(end=fail))
        return sources[-1]

    with ScriptedCamera(connect, timeout=0.2) as camera:
        plugged.clear()
        sources[0].ends.set()
        eventually(sources[0].closed.is_set)
        time.sleep(0.35)
        with pytest.raises(DeviceError, match=r"'top': no new frame for 0\.\d+ s.*no such device"):
            camera.latest()
        plugged.set()
        eventually(lambda: len(sources) == 2 and camera.frames(0)[-1].index > 0)
        eventually(lambda: time.monotonic() - camera.frames(0)[-1].arrival < 0.1)
        camera.latest()
        assert camera.statistics().n_reopened == 1
    eventually(sources[1].closed.is_set)


def test_a_hanging_read_hangs_neither_latest_nor_close():
    release = threading.Event()
    source = ScriptedSource(end=release.wait)
    camera = ScriptedCamera(lambda: source, timeout=0.1)
    camera.open()
    source.ends.set()
    time.sleep(0.2)
    with pytest.raises(DeviceError, match="no new frame"):
        camera.latest()
    start = time.monotonic()
    camera.close()
    assert time.monotonic() - start < 3.0
    assert not source.closed.is_set()
    camera.close()
    # The camera can be used again, and the old thread ends its own connection alone.
    fresh = ScriptedSource()
    camera._connect = lambda: fresh
    camera.open()
    release.set()
    eventually(source.closed.is_set)
    camera.latest()
    assert not fresh.closed.is_set()
    camera.close()
    assert fresh.closed.is_set()


def test_open_says_why_it_fails():
    def refuse():
        raise OSError("permission denied")

    with pytest.raises(DeviceError, match="'top' cannot be opened: permission denied"):
        ScriptedCamera(refuse).open()


def test_open_does_not_wait_for_ever():
    release = threading.Event()
    camera = ScriptedCamera(lambda: release.wait() and None)
    start = time.monotonic()
    with pytest.raises(DeviceError, match="'top' cannot be opened: no frame within 0.5 s"):
        camera.open()
    assert time.monotonic() - start < 3.0
    release.set()


def test_a_wrong_size_is_refused_with_both():
    source = ScriptedSource(np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(DeviceError, match="'top'.*expected images of 32x24.*got 64x48"):
        ScriptedCamera(lambda: source).open()
    assert source.closed.is_set()


def test_a_damaged_image_is_no_lost_stream():
    source = ScriptedSource()
    reads = iter([DamagedImageError("torn")])

    def read():
        for error in reads:
            raise error
        time.sleep(0.01)
        return Shot(IMAGE, None)

    source.read = read
    with ScriptedCamera(lambda: source) as camera:
        assert camera.statistics().n_dropped >= 1
        assert not source.closed.is_set()


def test_a_closed_camera_says_so():
    camera = ScriptedCamera(ScriptedSource)
    for ask in (camera.latest, lambda: camera.frames(0.0), camera.statistics):
        with pytest.raises(DeviceError, match="'top' is not open"):
            ask()


def matched(tolerance, *stamps):
    found = newest_match([[frame(t) for t in each] for each in stamps], tolerance)
    return None if found is None else [each.stamp for each in found]


def test_newest_set_within_tolerance():
    assert matched(0.01, [1.0, 1.1, 1.2], [1.001, 1.101]) == [1.1, 1.101]
    assert matched(0.01, [1.0, 1.1], [1.05, 1.15]) is None
    assert matched(0.06, [1.0, 1.1], [1.05, 1.15]) == [1.1, 1.15]
    assert matched(0.01, [1.0], []) is None
    assert matched(0.0, [1.0, 2.0]) == [2.0]


def test_a_fast_camera_gives_its_frame_closest_to_the_slow_one():
    fast = [1.0 + i / 100 for i in range(20)]
    assert matched(0.05, fast, [1.053, 1.153]) == pytest.approx([1.15, 1.153])
    assert matched(0.05, fast, [1.058, 1.158]) == pytest.approx([1.16, 1.158])


@pytest.mark.parametrize("seed", range(20))
def test_match_against_all_combinations(seed):
    rng = np.random.default_rng(seed)
    a, b = (np.sort(rng.uniform(0, 1, n)) for n in (12, 7))
    tolerance = 0.04
    spread = np.abs(a[:, None] - b[None])
    found = matched(tolerance, a, b)
    if (spread <= tolerance).any():
        assert found is not None
        # No acceptable pair is newer in both, and none that shares a frame is closer and newer.
        i, j = list(a).index(found[0]), list(b).index(found[1])
        assert spread[i, j] <= tolerance
        assert not (spread[i + 1 :, j + 1 :] <= tolerance).any()
        assert spread[i, j] <= spread[i + 1 :, j].min(initial=1.0)
        assert spread[i, j] <= spread[i, j + 1 :].min(initial=1.0)
    else:
        assert found is None


class BufferedCamera:
    def __init__(self, stamps, gone=False):
        self.stamps, self.gone = stamps, gone

    def frames(self, since):
        return [frame(t) for t in self.stamps if t > since]

    def latest(self):
        if self.gone:
            raise DeviceError("camera 'top': no new frame for 2 s")
        return frame(self.stamps[-1])


def test_each_set_is_new_in_every_view():
    cameras = [BufferedCamera([1.0, 1.1, 1.2]), BufferedCamera([1.0, 1.1])]
    found = synchronised(cameras, 0.0, 0.01)
    assert [each.stamp for each in found] == [1.1, 1.1]
    assert synchronised(cameras, 1.1, 0.01) is None
    cameras[1].stamps = [1.0, 1.1, 1.2]
    assert [each.stamp for each in synchronised(cameras, 1.1, 0.01)] == [1.2, 1.2]


def test_a_silent_camera_is_no_missing_set():
    cameras = [BufferedCamera([1.0, 1.1]), BufferedCamera([1.0], gone=True)]
    with pytest.raises(DeviceError, match="'top'"):
        synchronised(cameras, 1.0, 0.01)


@pytest.mark.parametrize(
    ("name", "value"),
    [("driver", "webcam"), ("stamps", "ntp"), ("latency", -1.0), ("rate_hz", 0.0), ("timeout", 0)],
)
def test_settings_are_checked(name, value):
    with pytest.raises(ValueError, match=f"^{name}: expected"):
        CameraSettings(**({"driver": "mjpeg"} | {name: value}))


def test_make_camera_by_driver():
    settings = CameraSettings("mjpeg", "http://127.0.0.1:1/", latency=0.03, timeout=0.7)
    camera = make_camera(settings, MODEL)
    assert isinstance(camera, MjpegCamera)
    assert (camera.latency, camera.timeout, camera.model) == (0.03, 0.7, MODEL)
    assert isinstance(make_camera(CameraSettings("opencv", 0), MODEL), OpenCVCamera)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """Ten frames at 20 Hz, red on the left, blue on the right, brightening."""
    path = tmp_path_factory.mktemp("clip") / "clip.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, (32, 24))
    for i in range(10):
        image = np.full((24, 32, 3), 20 * i, np.uint8)
        image[:, :16] = (0, 0, 255)
        image[:, 16:, 0] = 255
        writer.write(image)
    writer.release()
    return path


def file_camera(clip, **options):
    settings = CameraSettings("opencv", str(clip), timeout=0.3)
    return OpenCVCamera(settings, MODEL, **options)


def test_a_file_plays_at_its_rate_in_rgb_then_ends(clip):
    with file_camera(clip) as camera:
        eventually(lambda: camera.frames(0)[-1].index == 9)
        frames = camera.frames(0)
        assert np.median(np.diff([each.stamp for each in frames])) == pytest.approx(0.05, abs=0.02)
        left, right = frames[-1].image[12, 4], frames[-1].image[12, 28]
        assert left[0] > 200 > 60 > left[2]
        assert right[2] > 200
        brightness = [int(each.image[12, 28, 1]) for each in frames]
        assert brightness == sorted(brightness)
        time.sleep(0.35)
        with pytest.raises(DeviceError, match="no new frame.*clip.avi' has been played to its end"):
            camera.latest()


def test_a_file_as_fast_as_it_decodes_and_in_a_loop(clip):
    start = time.monotonic()
    with file_camera(clip, realtime=False, loop=True) as camera:
        eventually(lambda: camera.latest().index > 25)
    assert time.monotonic() - start < 1.0  # 1.3 s at its rate


def test_a_file_of_another_size(clip):
    other = CameraModel.looking_at("side", (0, 0, 1), (0, 0, 0), up=(0, 1, 0), width=64, height=48)
    with pytest.raises(DeviceError, match="'side'.*64x48.*got 32x24"):
        OpenCVCamera(CameraSettings("opencv", str(clip)), other).open()


@pytest.mark.parametrize(
    ("device", "message"),
    [
        ("no/such/clip.mp4", "there is no file"),
        (97, "there is no device /dev/video97"),
        ("/dev/video98", "there is no device /dev/video98"),
        ("rtsp://127.0.0.1:9/stream", r"cannot open 'rtsp.* \(url\)"),
        ("videotestsrc ! appsink", "GStreamer"),
    ],
)
def test_what_cannot_be_opened_is_named_in_time(device, message):
    start = time.monotonic()
    with pytest.raises(DeviceError, match=f"'top' cannot be opened.*{message}"):
        OpenCVCamera(CameraSettings("opencv", device), MODEL).open()
    assert time.monotonic() - start < 3.5


def test_device_kinds():
    kinds = {
        0: "v4l2",
        "1": "v4l2",
        "/dev/video2": "v4l2",
        "/dev/v4l/by-id/usb-cam": "v4l2",
        "rtsp://user@host/stream": "url",
        "v4l2src ! videoconvert ! appsink": "gstreamer",
        "recordings/top.mp4": "file",
    }
    assert {device: device_kind(device) for device in kinds} == kinds
    for wrong in ("", -1):
        with pytest.raises(ValueError, match="device"):
            device_kind(wrong)


def test_header_stamps_are_refused_where_there_are_none(clip):
    with pytest.raises(ValueError, match="stamps"):
        OpenCVCamera(CameraSettings("opencv", str(clip), stamps="header"), MODEL)


class FakeVideoCapture:
    """A V4L2 device that rounds the size asked for to its own."""

    def __init__(self, stamp):
        self.stamp = stamp
        self.asked = {}

    def isOpened(self):
        return True

    def set(self, name, value):
        self.asked[name] = value

    def get(self, name):
        assert name == cv2.CAP_PROP_POS_MSEC
        return 1e3 * self.stamp()

    def grab(self):
        time.sleep(0.01)
        return True

    def retrieve(self):
        return True, np.full((24, 32, 3), (255, 0, 0), np.uint8)

    def release(self):
        pass


def v4l2_camera(monkeypatch, device, stamps):
    monkeypatch.setattr(opencv_camera.Path, "exists", lambda path: True)
    monkeypatch.setattr(opencv_camera.cv2, "VideoCapture", lambda *arguments: device)
    settings = CameraSettings("opencv", "/dev/video0", latency=0.1, rate_hz=30.0, stamps=stamps)
    return OpenCVCamera(settings, MODEL)


def test_v4l2_takes_size_rate_and_the_drivers_stamp(monkeypatch):
    device = FakeVideoCapture(lambda: time.monotonic() - 0.025)
    with v4l2_camera(monkeypatch, device, "auto") as camera:
        newest = camera.latest()
    assert newest.arrival - newest.stamp == pytest.approx(0.025, abs=0.01)
    assert newest.image[0, 0].tolist() == [0, 0, 255]
    asked = [cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT, cv2.CAP_PROP_FPS]
    assert [device.asked[name] for name in asked] == [32, 24, 30.0]


def test_v4l2_driver_on_another_clock(monkeypatch):
    device = FakeVideoCapture(time.time)
    with pytest.raises(DeviceError, match='not on the monotonic clock.*stamps = "arrival"'):
        v4l2_camera(monkeypatch, device, "header").open()
    with v4l2_camera(monkeypatch, device, "arrival") as camera:
        newest = camera.latest()
    assert newest.arrival - newest.stamp == pytest.approx(0.1)


def test_oak_without_depthai(monkeypatch):
    monkeypatch.setitem(sys.modules, "depthai", None)
    with pytest.raises(MissingExtra, match=r"depthai is not installed.*dlo-gym\[oak\]"):
        make_camera(CameraSettings("oak"), MODEL)


class FakeOak:
    """The part of depthai 3 that the driver uses, with a blue picture."""

    CameraExposureOffset = SimpleNamespace(MIDDLE="middle")
    node = SimpleNamespace(Camera="camera")

    def __init__(self):
        self.log = []

    def Device(self, *which):
        self.log.append(("device", *which))
        return SimpleNamespace(close=lambda: self.log.append("device closed"))

    def DeviceInfo(self, name):
        return name

    def Pipeline(self, device):
        queue = SimpleNamespace(get=self.get, close=lambda: None)
        output = SimpleNamespace(createOutputQueue=lambda maxSize, blocking: queue)

        def request(size, fps):
            self.log.append((size, fps))
            return output

        camera = SimpleNamespace(requestOutput=request)
        return SimpleNamespace(
            create=lambda kind: SimpleNamespace(build=lambda: camera),
            start=lambda: self.log.append("started"),
            stop=lambda: self.log.append("stopped"),
        )

    def get(self, timeout):
        time.sleep(0.01)
        return self.packet(time.monotonic() - 0.03)

    def packet(self, stamp):
        return SimpleNamespace(
            getCvFrame=lambda: np.full((24, 32, 3), (255, 0, 0), np.uint8),
            getTimestamp=lambda offset: {"middle": timedelta(seconds=stamp)}[offset],
        )


def test_oak_on_a_fake_device(monkeypatch):
    fake = FakeOak()
    monkeypatch.setitem(sys.modules, "depthai", fake)
    with OakCamera(CameraSettings("oak", "10.0.0.7", rate_hz=25.0), MODEL) as camera:
        newest = camera.latest()
    assert newest.image[0, 0].tolist() == [0, 0, 255]
    assert newest.arrival - newest.stamp == pytest.approx(0.03, abs=0.01)
    assert fake.log == [
        ("device", "10.0.0.7"),
        ((32, 24), 25.0),
        "started",
        "stopped",
        "device closed",
    ]


def test_packet_of_the_real_depthai():
    dai = pytest.importorskip("depthai")
    packet = dai.ImgFrame()
    packet.setCvFrame(np.full((24, 32, 3), (255, 0, 0), np.uint8), dai.ImgFrame.Type.BGR888i)
    packet.setTimestamp(timedelta(seconds=12.5))
    shot = shot_of_packet(packet, dai.CameraExposureOffset.MIDDLE)
    assert shot.image[0, 0].tolist() == [0, 0, 255]
    assert shot.stamp == pytest.approx(12.5, abs=1e-3)
    assert shot_of_packet(packet).stamp is None
    assert abs(dai.Clock.now().total_seconds() - time.monotonic()) < 0.05


@pytest.fixture(scope="module")
def scene():
    """A model and a rod state that the simulated cell can hold; skips without OpenGL."""
    model = default_cameras(1 / 6)[0]
    t = np.linspace(0.0, 1.0, 51)
    positions = np.column_stack([-0.2 + 0.4 * t, 0 * t, 0.34 - 0.1 * np.sin(np.pi * t) ** 2])
    clamp = np.eye(4)
    clamp[:3, :3] = [[0, 0, 1], [1, 0, 0], [0, 1, 0]]
    left, right = clamp.copy(), clamp.copy()
    left[:3, 3], right[:3, 3] = positions[0], positions[-1]
    return model, SimpleNamespace(positions=positions, boundary=BoundaryPoses(left, right))


def rendered(model, state, **options):
    camera = RenderedCamera(model, state, **options)
    try:
        camera.open()
    except DeviceError as error:
        if isinstance(error.__cause__, RenderingUnavailable) or "OpenGL" in str(error):
            pytest.skip(str(error))
        raise
    return camera


def test_rendered_on_demand_shows_the_present_state(scene):
    model, state = scene
    calls = []

    def present():
        calls.append(time.monotonic())
        return state

    with rendered(model, present) as camera:
        image = camera.latest().image
        n_calls = len(calls)
        time.sleep(0.1)
        assert len(calls) == n_calls  # draws at no other time
        before = time.monotonic()
        state.positions = state.positions - [0.0, 0.0, 0.05]
        newest = camera.latest()
        assert before < newest.stamp < time.monotonic()
        assert len(camera.frames(before)) == 2
    assert (newest.image != image).any()
    with SceneRenderer(camera._scene) as renderer:
        renderer.update(state.positions, state.boundary)
        assert np.array_equal(renderer.render(model.name).image, newest.image)


def test_rendered_at_a_rate_and_both_views_at_once(scene):
    model, state = scene
    top = default_cameras(1 / 6)[1]
    with (
        rendered(model, lambda: state, rate_hz=20.0) as one,
        rendered(top, lambda: state, rate_hz=20.0) as other,
    ):
        time.sleep(0.8)
        found = synchronised([one, other], 0.0, 0.06)
        rate = one.statistics().rate_hz
    assert found is not None
    assert rate == pytest.approx(20.0, rel=0.3)


def test_rendered_says_what_its_scene_raised(scene):
    model, state = scene
    broken = []

    def present():
        if broken:
            raise RuntimeError("the rod is gone")
        return state

    with rendered(model, present, timeout=0.3) as camera:
        broken.append(True)
        with pytest.raises(DeviceError, match="the rod is gone"):
            camera.latest()
