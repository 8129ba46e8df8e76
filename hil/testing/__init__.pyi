from .bench import Bench as Bench
from .conformance import robot_conformance as robot_conformance
from .contract_tests import RobotConformance as RobotConformance
from .mock_ur_controller import ur_controller as ur_controller
from .new_driver import driver_files as driver_files
