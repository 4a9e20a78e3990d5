"""A recorded bag through the online estimator, without ROS: :func:`rotavg_ros.replay.run.replay` and its outputs."""
