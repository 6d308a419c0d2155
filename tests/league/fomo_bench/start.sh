#!/bin/sh
# Publish /estimated_odom from the bag that fomo-bench plays; with TRACK=lidar_graph the graph's live poses are its trajectory.txt.
# Arguments are those of `skidloc online`: a log and `--rate max` run it without ROS.
set -eu
out=${STORAGE_PATH:-.}
case "${TRACK:-lidar}" in
proprioceptive) estimator=odometry ;;
lidar) estimator=ekf ;;
lidar_graph) estimator=graph ;;
*)
    echo "TRACK is $TRACK: give proprioceptive, lidar or lidar_graph." >&2
    exit 2
    ;;
esac
rm -f "$out/skidloc.tum"
trap : INT TERM
skidloc online "$@" --robot "$ROBOT" --estimator "$estimator" --interface default --out "$out/skidloc.tum" \
    --node.use-sim-time --node.no-tf --node.names.remap '~/odometry:=/estimated_odom' || true
test -f "$out/skidloc.tum" || exit 1
if [ "$estimator" = graph ]; then mv "$out/skidloc.tum" "$out/trajectory.txt"; fi
