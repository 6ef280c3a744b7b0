#!/bin/sh
# A SLURM of one node on this machine, for benchmarks/cohort_slurm.py: run as root on Debian, in a container too.
#   benchmarks/cohort_slurm_setup.sh start FOLDER    installs slurm-wlm where it is missing, starts munge and SLURM
#   benchmarks/cohort_slurm_setup.sh stop FOLDER
# Prints what to export. State, logs and slurm.conf are in FOLDER; nothing of a SLURM that is already there is touched.
set -eu
what=$1
mkdir -p "$2"
folder=$(cd "$2" && pwd)
if [ "$what" = stop ]; then
  for name in slurmd slurmctld munged; do
    if [ -f "$folder/$name.pid" ]; then kill "$(cat "$folder/$name.pid")" || true; fi
  done
  exit 0
fi
command -v slurmctld > /dev/null || apt-get install --yes --quiet slurm-wlm munge >&2
host=$(hostname -s)
memory=$(awk '/MemTotal/ {print int($2 / 1024 * 0.9)}' /proc/meminfo)
mkdir -p "$folder/state" "$folder/spool"
[ -f "$folder/munge.key" ] || dd if=/dev/urandom of="$folder/munge.key" bs=1024 count=1 2> /dev/null
chmod 0400 "$folder/munge.key"
chmod 0755 "$folder"
cat > "$folder/slurm.conf" << END
ClusterName=palpate
SlurmctldHost=$host
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket=$folder/munge.socket
CryptoType=crypto/munge
SlurmctldPort=16817
SlurmdPort=16818
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core_Memory
MpiDefault=none
ReturnToService=2
NodeName=$host NodeAddr=127.0.0.1 CPUs=$(nproc) RealMemory=$memory State=UNKNOWN
PartitionName=main Nodes=$host Default=YES MaxTime=INFINITE State=UP
END
export SLURM_CONF="$folder/slurm.conf"
munged --force --key-file="$folder/munge.key" --socket="$folder/munge.socket" --pid-file="$folder/munged.pid" \
  --log-file="$folder/munged.log" --seed-file="$folder/munged.seed" >&2
slurmctld
slurmd
for _ in 1 2 3 4 5 6 7 8 9 10; do
  sinfo --noheader --format=%t 2> /dev/null | grep -q idle && break
  sleep 1
done
sinfo >&2
echo "export SLURM_CONF=$folder/slurm.conf"
