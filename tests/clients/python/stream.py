#!/usr/bin/env python3
"""Streams a TUM RGB-D sequence into an agent and prints the poses that it gives back, as TUM lines.

    pip install grpcio grpcio-tools
    python3 stream.py kitchen --to 127.0.0.1:7001 --frames 100 > poses.tum

Everything that it knows of the agent comes from the .proto files, which are compiled when it starts.
"""
import argparse
import importlib
import pathlib
import sys
import tempfile

import grpc
from grpc_tools import protoc

PROTO = pathlib.Path(__file__).resolve().parents[3] / "proto"


def contract():
    """Compiles the contract into a temporary folder and imports it."""
    out = tempfile.mkdtemp(prefix="coma-proto-")
    files = [str(f.relative_to(PROTO)) for f in sorted((PROTO / "coma/v1").glob("*.proto"))]
    if protoc.main(["protoc", f"-I{PROTO}", f"--python_out={out}", f"--grpc_python_out={out}", *files]) != 0:
        sys.exit("the contract could not be compiled")
    sys.path.insert(0, out)
    return (importlib.import_module("coma.v1.agent_pb2"), importlib.import_module("coma.v1.agent_pb2_grpc"),
            importlib.import_module("coma.v1.types_pb2"), importlib.import_module("coma.v1.viewer_pb2"),
            importlib.import_module("coma.v1.viewer_pb2_grpc"))


def nanoseconds(seconds):
    """A stamp's text in nanoseconds, exactly."""
    whole, _, fraction = seconds.partition(".")
    return int(whole) * 10**9 + int((fraction + "0" * 9)[:9])


def sequence(folder, limit):
    """(stamp, colour file, depth file) of each frame, and the camera's numbers."""
    lines = [l.split() for l in (folder / "associations.txt").read_text().splitlines() if l and not l.startswith("#")]
    numbers = [l for l in (folder / "calibration.txt").read_text().splitlines() if l and not l.startswith("#")]
    return [(l[0], folder / l[1], folder / l[3]) for l in lines[:limit]], [float(n) for n in numbers[0].split()]


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--to", default="127.0.0.1:7001", help="the agent, host:port")
    parser.add_argument("--frames", type=int, default=None, help="only the first so many")
    parser.add_argument("--session", default="python")
    arguments = parser.parse_args()
    agent_pb2, agent_grpc, types_pb2, viewer_pb2, viewer_grpc = contract()
    frames, (width, height, fx, fy, cx, cy, units) = sequence(arguments.folder, arguments.frames)

    channel = grpc.insecure_channel(arguments.to, options=[("grpc.max_receive_message_length", 16 << 20)])
    agent = agent_grpc.AgentStub(channel)
    camera = types_pb2.Intrinsics(width=int(width), height=int(height), fx=fx, fy=fy, cx=cx, cy=cy)
    calibration = types_pb2.Calibration(
        color=camera, depth_units_per_metre=units,
        depth_noise=types_pb2.DepthNoise(base_m=0.001, quadratic_per_m=0.0019))
    opened = agent.OpenSession(agent_pb2.OpenSessionRequest(
        session_id=arguments.session, calibration=calibration, policy=agent_pb2.QUEUE_POLICY_BLOCK,
        clock_domain=types_pb2.CLOCK_DOMAIN_DEVICE))

    def messages():
        # A session that is resumed goes on where the agent wants it.
        for index, (stamp, color, depth) in list(enumerate(frames))[opened.next_sequence:]:
            jpeg = color.suffix in (".jpg", ".jpeg")
            yield agent_pb2.StreamFramesRequest(session_id=opened.session_id, frame=agent_pb2.Frame(
                sequence=index, stamp_ns=nanoseconds(stamp),
                color_encoding=types_pb2.COLOR_ENCODING_JPEG if jpeg else types_pb2.COLOR_ENCODING_PNG,
                color=color.read_bytes(), depth_encoding=types_pb2.DEPTH_ENCODING_PNG16, depth=depth.read_bytes()))

    for answer in agent.StreamFrames(messages()):
        if answer.HasField("refusal"):
            sys.exit(f"frame {answer.refusal.sequence}: {answer.refusal.field}: {answer.refusal.message}")
        print(f"processed through {answer.ack.processed_through}", file=sys.stderr)
    agent.CloseSession(agent_pb2.CloseSessionRequest(session_id=opened.session_id))

    stamps = {nanoseconds(stamp): stamp for stamp, _, _ in frames}
    viewer = viewer_grpc.ViewerStub(channel)
    for answer in viewer.GetTrajectory(viewer_pb2.GetTrajectoryRequest(first_sequence=0)):
        for pose in answer.poses:
            p = pose.map_from_camera
            print(stamps[pose.stamp_ns], *(f"{v:.9f}" for v in (p.tx_m, p.ty_m, p.tz_m, p.qx, p.qy, p.qz, p.qw)))


if __name__ == "__main__":
    main()
