"""Manages a lifecycle node from another process, by ROS 2's services.

python manager.py NODE. Each line of the standard input is JSON, [operation, argument]; the answer is one line of JSON.
"""

import json
import sys

import rclpy
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter
from std_srvs.srv import Empty, SetBool, Trigger

WAIT_S = 60.0


class Manager:
    def __init__(self, target):
        self.node, self.target = rclpy.create_node("manager"), target

    def call(self, kind, name, **fields):
        client = self.node.create_client(kind, f"{self.target}/{name}")
        assert client.wait_for_service(timeout_sec=WAIT_S), f"no service {name}"
        future = client.call_async(kind.Request(**fields))
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=WAIT_S)
        assert future.done(), f"{name} does not answer"
        self.node.destroy_client(client)
        return future.result()

    def state(self, _):
        return self.call(GetState, "get_state").current_state.label

    def change(self, label):
        transition = Transition(id=getattr(Transition, f"TRANSITION_{label.upper()}"))
        return self.call(ChangeState, "change_state", transition=transition).success

    def names(self, _):
        return list(self.call(ListParameters, "list_parameters").result.names)

    def get(self, name):
        (value,) = self.call(GetParameters, "get_parameters", names=[name]).values
        return [None, value.bool_value, value.integer_value, value.double_value, value.string_value][min(value.type, 4)]

    def describe(self, name):
        (descriptor,) = self.call(DescribeParameters, "describe_parameters", names=[name]).descriptors
        return [descriptor.description, descriptor.additional_constraints]

    def reset(self, _):
        return self.call(Empty, "reset") is not None

    def pause(self, is_paused):
        return self.call(SetBool, "pause", data=is_paused).success

    def tare_payload(self, _):
        return self.call(Trigger, "tare_payload").success

    def set(self, argument):
        name, value = argument
        (result,) = self.call(SetParameters, "set_parameters", parameters=[Parameter(name, value=value).to_parameter_msg()]).results
        return [result.successful, result.reason]


def main():
    rclpy.init(args=[])
    manager = Manager(sys.argv[1])
    print("up", flush=True)
    for line in sys.stdin:
        operation, argument = json.loads(line)
        print(json.dumps([getattr(manager, operation)(argument)]), flush=True)
    manager.node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
