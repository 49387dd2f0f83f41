// A stand-in for ros2_control's controller_interface: what an exported controller uses of it, with
// the names and types of ROS 2 Jazzy (control.ros.org/jazzy).
#pragma once

#include <map>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "rclcpp/rclcpp.hpp"

namespace controller_interface
{
enum class CallbackReturn { SUCCESS, FAILURE, ERROR };
enum class return_type { OK, ERROR };
enum class interface_configuration_type { ALL, INDIVIDUAL, NONE };

struct InterfaceConfiguration
{
  interface_configuration_type type;
  std::vector<std::string> names = {};
};

struct Interface  // hardware_interface::LoanedStateInterface and LoanedCommandInterface
{
  double * value;
  double get_value() const { return *value; }
  [[nodiscard]] bool set_value(double other) { *value = other; return true; }
};

class ControllerInterface
{
public:
  virtual ~ControllerInterface() = default;
  virtual CallbackReturn on_init() = 0;
  virtual InterfaceConfiguration command_interface_configuration() const = 0;
  virtual InterfaceConfiguration state_interface_configuration() const = 0;
  virtual CallbackReturn on_configure(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_activate(const rclcpp_lifecycle::State &) = 0;
  virtual CallbackReturn on_deactivate(const rclcpp_lifecycle::State &) = 0;
  virtual return_type update(const rclcpp::Time &, const rclcpp::Duration &) = 0;

  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> get_node() const { return node; }
  unsigned int get_update_rate() const { return rate; }

  std::shared_ptr<rclcpp_lifecycle::LifecycleNode> node =
    std::make_shared<rclcpp_lifecycle::LifecycleNode>();
  unsigned int rate = 0;
  std::vector<Interface> command_interfaces_, state_interfaces_;

protected:
  template <typename T>
  void auto_declare(const std::string & name, const T & value)
  {
    node->declare(name, rclcpp::Parameter(value));
  }
};
}  // namespace controller_interface
