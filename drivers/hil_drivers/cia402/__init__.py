"""An arm on CiA 402 drives: CANopen by CAN now, the same object dictionary as EtherCAT's CoE."""
