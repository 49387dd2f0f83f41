// A stand-in for the controller manager: it takes a controller through its life in the manager's
// order. Arguments: update rate, and after a colon the manager's own, Hz; "positions" or "velocities", the joints. Each line of numbers is
// one period's states; the answer is the commands, and at the end those after deactivation.
#include <cmath>
#include <cstdlib>
#include <iostream>

#include "controller_interface/controller_interface.hpp"

controller_interface::ControllerInterface * stub_make();

static std::vector<controller_interface::Interface> lend(
  const std::vector<std::string> & names, std::map<std::string, double> & hardware)
{
  std::vector<controller_interface::Interface> lent;
  for (const auto & name : names) {
    std::cout << name << " ";
    lent.push_back({&hardware.emplace(name, std::nan("")).first->second});
  }
  std::cout << "\n";
  return lent;
}

static void show(const std::vector<controller_interface::Interface> & commands)
{
  for (const auto & one : commands) {
    std::printf("%.17g ", one.get_value());
  }
  std::printf("\n");
}

int main(int count, char ** words)
{
  using controller_interface::CallbackReturn;
  const std::unique_ptr<controller_interface::ControllerInterface> made(stub_make());
  std::map<std::string, double> hardware;
  const std::string rates = words[1];
  made->rate = static_cast<unsigned int>(std::atoi(words[1]));
  const double real = std::atof(rates.substr(rates.find(':') + 1).c_str());
  if (made->on_init() != CallbackReturn::SUCCESS) {
    return 3;
  }
  made->node->declare(
    "joints", rclcpp::Parameter(std::vector<std::string>(words + 3, words + count)));
  made->node->declare("use_velocities", rclcpp::Parameter(std::string(words[2]) == "velocities"));
  if (made->on_configure({}) != CallbackReturn::SUCCESS) {
    return 2;
  }
  made->command_interfaces_ = lend(made->command_interface_configuration().names, hardware);
  made->state_interfaces_ = lend(made->state_interface_configuration().names, hardware);
  std::cout.flush();
  if (made->on_activate({}) != CallbackReturn::SUCCESS) {
    return 4;
  }
  for (;;) {
    for (auto & state : made->state_interfaces_) {
      std::string number;
      if (!(std::cin >> number)) {
        (void)made->on_deactivate({});
        show(made->command_interfaces_);
        return 0;
      }
      (void)state.set_value(std::atof(number.c_str()));
    }
    const bool sound =
      made->update({}, rclcpp::Duration(1 / real)) == controller_interface::return_type::OK;
    show(made->command_interfaces_);
    if (!sound) {
      return 5;
    }
  }
}
