"""valve_drake: a humanoid on wheels finds a valve by its red rectangle, grasps it with both hands and turns it.

After Xu, Tan, Jiang, Hu: "Use of Colour and Shape Constraints in Vision-based Valve Operation by Robot". Every stage of
the paper is a LeafSystem; together they are one Drake diagram:

    station.images -> color_segmentation -> line_fitting -> rectangle_estimator -> base_approach, kinematic_approach
                                        \\-> stereo_positioning -> valve_search, base_approach
                   -> handle_marker (wrist cameras) -> kinematic_approach, image_servo
    station.joints, wrenches -> robot_state -> all behaviours
    all behaviours -> (command, status) -> command_selector -> station; statuses, health, operator -> supervisor -> mode

    valve-drake run                 # the whole work; its log and 3D recording go to logs/

| section of the paper                  | file                                  | block                |
|---------------------------------------|---------------------------------------|----------------------|
| 2 robot and strategy (four stages)    | diagram.py, supervisor/supervisor.py  | supervisor           |
| 2 audio commands sent via radio       | operator/grammar.py, operator_channel.py | operator_channel  |
| 2 stage 1: centre of the red area     | perception/stereo_positioning.py      | stereo_positioning   |
| 2 stages 1, 2: driving                | behaviors/base_approach.py            | base_approach        |
| 2 stage 3: hands by kinematics        | behaviors/kinematic_approach.py       | kinematic_approach   |
| 2 stage 4: image-based servoing       | behaviors/image_servo.py              | image_servo          |
| 2 stage 4: hybrid control (5 here)    | behaviors/hybrid_rotation.py          | hybrid_rotation      |
| 3 camera model, eq. (1)-(3)           | camera/lens.py                        |                      |
| 4 visual positioning, eq. (4)-(25)    | perception/rectangle_estimator.py     | rectangle_estimator  |
| 5.2 edges by Hough transform          | perception/line_fitting.py            | line_fitting         |
| colour of the marker, of the handles  | perception/color_segmentation.py, handle_marker.py | the same |

Frames, signs and units: frames.py. Messages on the ports: messages.py. How a block stands on ports: ports.py.
Everything that can be set: scenario.py. The wiring: diagram.py. The robot's side: stations/contract.py.
"""

__version__ = "0.1.0"
